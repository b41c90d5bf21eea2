"""A simulated episode as recorders see it: each stream with its own clock.

Clocks start at different times and jitter; the arm's readings have the noise of its encoders. Times
are seconds since the epoch.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.arm import robot_state
from pipeline.simulation.insertion import ENCODER_NOISE, INSERTED, STATE_HZ, NeedleInsertion
from pipeline.simulation.insertion_layout import WORKSPACE_MM, InsertionLayout, draw_layout
from pipeline.simulation.needle_sensor import READING_HZ
from pipeline.simulation.rendering import photograph

CAMERA_HZ: Final = 10

_LATE_S: Final = 0.08
_ROBOT_JITTER_S, _SENSOR_JITTER_S, CAMERA_JITTER_S = 4e-4, 8e-5, 3e-3
LOST_FRAMES = 0.01
_START_MM = (1.8, 5.0)
"""Bounds of the height at which demonstrations begin; some begin lower than a rollout does."""
_NOISE_MM, _NOISE_DEG = 0.02, 0.02
"""Standard deviation of the noise of every tick's motion, in every direction."""
_NUDGES, _NUDGE_MM = 4, (0.3, 1.2)
"""Number of nudges of the phantom in a demonstration, in addition to its pushes, and bounds of the
distance by which a nudge moves the target."""


@dataclass(frozen=True)
class Demonstration:
    """One finished episode that began at `epoch_s`, and the generator of its clocks' jitter.

    `sensor` (reading, 1026) is at 650 Hz; the first reading is 1/650 s after the beginning.
    """

    insertion: NeedleInsertion
    sensor: NDArray[np.float32]
    epoch_s: float
    rng: np.random.Generator

    @property
    def duration_s(self) -> float:
        """Length of the episode."""
        return self.insertion.time_s

    @property
    def stamp(self) -> str:
        """The beginning in UTC, in the form that recorders use in names."""
        return datetime.fromtimestamp(self.epoch_s, UTC).strftime("%Y%m%d_%H%M%S")

    @cached_property
    def sensor_time(self) -> NDArray[np.float64]:
        """The sensor's jittered clock, one time for each row of `sensor`."""
        nominal = self.epoch_s + np.arange(1, len(self.sensor) + 1) / READING_HZ
        return _jittered(nominal, _SENSOR_JITTER_S, self.rng)

    def robot_clock(self, jitter_s: float = _ROBOT_JITTER_S) -> NDArray[np.float64]:
        """A 100 Hz clock that begins late."""
        late = self.rng.uniform(0, _LATE_S)
        nominal = self.epoch_s + late + np.arange((self.duration_s - late) * STATE_HZ) / STATE_HZ
        return _jittered(nominal, jitter_s, self.rng)

    def camera_clock(self, late_s: float | None = None) -> NDArray[np.float64]:
        """A 10 Hz clock in whole milliseconds that begins late and loses a frame now and then."""
        late = self.rng.uniform(0, _LATE_S) if late_s is None else late_s
        frames = np.arange((self.duration_s - late) * CAMERA_HZ)
        times = _jittered(self.epoch_s + late + frames / CAMERA_HZ, CAMERA_JITTER_S, self.rng)
        kept = self.rng.random(len(times)) >= LOST_FRAMES
        times[0], kept[0] = self.epoch_s + late, True
        return np.round(times[kept], 3)

    def states(self, time: NDArray[np.float64]) -> NDArray[np.float32]:
        """Joints and pose (time, 12), with the encoders' noise."""
        exact = robot_state(self.poses(time))
        noise = self.rng.standard_normal(exact.shape) * ENCODER_NOISE
        return (exact + noise).astype(np.float32)

    def poses(self, time: NDArray[np.float64]) -> NDArray[np.float64]:
        """True poses (time, 6), angles not wrapped."""
        return self.insertion.poses(time - self.epoch_s)

    def frames(self, view: str, time: NDArray[np.float64]) -> Iterator[NDArray[np.uint8]]:
        """A camera's frames at these times, one by one."""
        for instant in time:
            yield photograph(view, self.insertion, float(instant) - self.epoch_s)


def simulate_episode(seed: int, epoch_s: float, crosses_180: bool = False) -> Demonstration:
    """A demonstration that succeeds, of this seed or of the next seed with one.

    Disturbances of the demonstrator put recoveries into the data, as in Laskey et al. 2017, "DART:
    Noise Injection for Robust Imitation Learning". Actions come from poses, so the labels contain
    what disturbs the arm: in every tick a little noise of mean 0. Larger misses come from nudges of
    the phantom, which do not change the labels. The same arguments give the same episode.
    """
    insertion, rng = NeedleInsertion(), np.random.default_rng([seed, 202])
    layout = _nudged(draw_layout(seed, "moved", crosses_180), rng)
    insertion.start(layout)
    readings = [insertion.sensor]
    while not insertion.finished:
        action = insertion.expert_action()
        noise = rng.standard_normal(6) * np.repeat([_NOISE_MM, _NOISE_DEG], 3)
        noise[:2] *= not insertion.inside
        action[:6] += noise
        insertion.step(action)
        readings.append(insertion.sensor)
    if insertion.outcome != INSERTED:
        return simulate_episode(seed + 1, epoch_s, crosses_180)
    rng = np.random.default_rng([seed, 201])
    return Demonstration(insertion, np.concatenate(readings), epoch_s, rng)


def _nudged(layout: InsertionLayout, rng: np.random.Generator) -> InsertionLayout:
    """The layout with nudges among its pushes, and with another height at the beginning."""
    start = layout.start_pose.copy()
    start[2] = layout.surfaces_mm[0] + rng.uniform(*_START_MM)
    pushes = layout.push_times_s.tolist()
    times = sorted([*pushes, *rng.uniform(0.4, 5.0, _NUDGES)])
    targets, surfaces, place = [layout.targets_mm[0]], [layout.surfaces_mm[0]], 0
    for time in times:
        place += time in pushes
        angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(*_NUDGE_MM)
        nudged = targets[-1] + far * np.array([np.cos(angle), np.sin(angle)])
        nudged = np.clip(nudged, -WORKSPACE_MM, WORKSPACE_MM)
        targets.append(layout.targets_mm[place] if time in pushes else nudged)
        surfaces.append(layout.surfaces_mm[place])
    return replace(
        layout,
        start_pose=start,
        targets_mm=np.stack(targets),
        surfaces_mm=np.array(surfaces),
        push_times_s=np.array(times),
    )


def _jittered(
    nominal: NDArray[np.float64], jitter_s: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """The clock with normal jitter, never going backwards."""
    return np.maximum.accumulate(nominal + jitter_s * rng.standard_normal(len(nominal)))
