"""The physics of a simulated needle insertion, one step a control tick.

A six-axis arm carries a needle over a soft phantom. A sticker on the phantom marks where to enter;
a layer inside the phantom is where to stop. What is hidden where:

- The bench stands elsewhere in every episode, and the cameras stand with it: the arm's pose says
  nothing about the target. Where the target lies sideways shows only in the images.
- The cameras see nothing of heights (`Scene` holds none). How far the tissue and the layer are
  shows only in the A-scan, and contact in the force.
- The phantom is pushed aside and up or down at random times, as a patient moves, as long as the
  needle is clear of it. So motion so far does not tell motion to come.

Mechanics along the needle (vertical; leans are small): tissue is a stiffening spring,
f = k1·u + k2·u² for an indentation u, until it is punctured at a set force; the surface then
springs back around the needle, and f = cutting + friction·depth, as in A. M. Okamura, C. Simone,
M. D. O'Leary, "Force modeling for needle insertion into soft tissue", IEEE TBME 51(10), 2004.
A needle inside holds the tissue: no more pushes, and bending is not modelled.

Between ticks everything moves in straight lines. Units: mm, degrees, N, s. `bench` frame: the base
frame moved sideways to the bench.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.arm import (
    ActionRotation,
    angles_deg,
    moved,
    orientation,
    robot_state,
    wrapped_deg,
)
from pipeline.simulation.expert import REACTION_TICKS, Percept, expert_motion
from pipeline.simulation.layout import InsertionLayout, draw_layout
from pipeline.simulation.needle_sensor import READING_HZ, NeedleContact, sensor_readings

TICK_HZ: Final = 10
TICK_S: Final = 1 / TICK_HZ
READINGS_PER_TICK: Final = READING_HZ // TICK_HZ
STATE_HZ: Final = 100
HUB_MM: Final = 8.0
"""Height of the needle's hub above its tip."""
MAX_TICKS: Final = 90

_PUSH_TICKS = 2
_CLEAR_MM = 1.1
"""The phantom is pushed only while the tip is farther away than this."""
_AT_LAYER_MM, _HOLD_TICKS = 0.08, 6


@dataclass(frozen=True)
class Scene:
    """All that the cameras can see, in the bench frame: nothing of heights.

    `needle_mm` (2,) the tip, `lean_mm` (2,) how far the hub stands beside it, `target_mm` (2,).
    """

    needle_mm: NDArray[np.float64]
    lean_mm: NDArray[np.float64]
    target_mm: NDArray[np.float64]
    brightness: float


@dataclass(frozen=True)
class InsertionObservation:
    """What a policy may see at the end of a tick.

    `state` (10, 12) and `sensor` (65, 1026) are the readings of the tick that ends at `time_s`;
    `scene` is for `rendering.render`.
    """

    time_s: float
    scene: Scene
    state: NDArray[np.float32]
    sensor: NDArray[np.float32]


@dataclass(frozen=True)
class Knot:
    """Where everything is at the end of a tick; between knots it moves in straight lines.

    `pose` (6,) in the base frame, its angles not wrapped; `target_mm` (2,) in the bench frame;
    `surface_mm` the height of the undisturbed surface in the base frame.
    """

    pose: NDArray[np.float64]
    target_mm: NDArray[np.float64]
    surface_mm: float


class NeedleInsertion:
    """A needle insertion to step through: `reset`, then `observe` and `step` until `finished`.

    The same seed and actions give the same observations, bit for bit. `action_rotation` says how
    the rotation channels of an action are meant.
    """

    layout: InsertionLayout
    knots: list[Knot]

    def __init__(self, action_rotation: ActionRotation = "rotvec") -> None:
        self.action_rotation: ActionRotation = action_rotation

    def reset(self, seed: int) -> InsertionObservation:
        """The first observation of the episode that this seed draws."""
        return self.start(draw_layout(seed))

    def start(self, layout: InsertionLayout) -> InsertionObservation:
        """The first observation of this very episode: the arm has stood still for one tick."""
        self.layout = layout
        self._upright = orientation(layout.upright_deg)
        self.inside = False
        self.knots = [Knot(layout.start_pose, layout.targets_mm[0], float(layout.surfaces_mm[0]))]
        self._place, self._pushing, self._due, self._held = 0, 0, 0, 0
        return self.step(np.zeros(7))

    @property
    def time_s(self) -> float:
        """Seconds since the episode began."""
        return (len(self.knots) - 1) * TICK_S

    @property
    def finished(self) -> bool:
        """Whether the tip has rested at the target layer, or time is up."""
        return self._held >= _HOLD_TICKS or len(self.knots) > MAX_TICKS

    def step(self, action: NDArray[np.float64]) -> InsertionObservation:
        """Carry out one tick: dx dy dz (mm, base frame), rotation (deg), gripper (ignored)."""
        now = self.knots[-1]
        pose = moved(now.pose, np.asarray(action, np.float64), self.action_rotation)
        target, surface = self._pushed(now)
        self.knots.append(Knot(pose, target, surface))
        self.contact = self._meet(now, self.knots[-1])
        resting = self.inside and abs(self.contact.layer_mm[-1]) < _AT_LAYER_MM
        self._held = self._held + 1 if resting else 0
        return self.observe()

    def observe(self) -> InsertionObservation:
        """What the last tick showed; asking again changes nothing."""
        tick = len(self.knots) - 1
        before, now = self.knots[-2].pose, self.knots[-1].pose
        part = np.arange(1, STATE_HZ // TICK_HZ + 1)[:, None] * (TICK_HZ / STATE_HZ)
        rng = np.random.default_rng([self.layout.seed, 101, tick])
        return InsertionObservation(
            time_s=self.time_s,
            scene=self.scene(self.time_s),
            state=robot_state(before + part * (now - before)),
            sensor=sensor_readings(self.contact, self.time_s - TICK_S, self.layout.oct_gain, rng),
        )

    def poses(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Poses (time, 6) at any times of the episode so far, angles not wrapped."""
        knots = np.stack([knot.pose for knot in self.knots])
        at = np.clip(time_s * TICK_HZ, 0, len(knots) - 1)
        first = np.minimum(at.astype(np.int64), len(knots) - 2)
        part = (at - first)[:, None]
        return knots[first] + part * (knots[first + 1] - knots[first])

    def scene(self, time_s: float) -> Scene:
        """What the cameras see at a time of the episode so far."""
        at = min(max(time_s * TICK_HZ, 0.0), len(self.knots) - 1.0)
        first = min(int(at), len(self.knots) - 2)
        before, after = self.knots[first : first + 2]
        pose = before.pose + (at - first) * (after.pose - before.pose)
        upward = (orientation(pose[3:]) * self._upright.inv()).apply([0.0, 0.0, HUB_MM])
        return Scene(
            needle_mm=pose[:2] - self.layout.bench_mm,
            lean_mm=upward[:2],
            target_mm=before.target_mm + (at - first) * (after.target_mm - before.target_mm),
            brightness=self.layout.brightness,
        )

    def expert_action(self) -> NDArray[np.float64]:
        """The demonstrator's next action (7,), in the convention of `step`; gripper 1."""
        before, now = self.knots[-2].pose, self.knots[-1].pose
        seen = self.knots[max(0, len(self.knots) - 1 - REACTION_TICKS)]
        spun = (orientation(now[3:]) * orientation(before[3:]).inv()).as_rotvec(degrees=True)
        percept = Percept(
            offset_mm=seen.target_mm - (now[:2] - self.layout.bench_mm),
            distance_mm=float(now[2]) - seen.surface_mm,
            layer_mm=float(self.contact.layer_mm[-1]),
            inside=self.inside,
            turn_deg=(self._upright * orientation(now[3:]).inv()).as_rotvec(degrees=True),
            velocity=np.concatenate([now[:3] - before[:3], spun]),
        )
        rng = np.random.default_rng([self.layout.seed, 102, len(self.knots)])
        motion = expert_motion(percept, self.layout.speed_mm_s, TICK_S, rng)
        if self.action_rotation == "euler_delta":
            motion[3:] = wrapped_deg(
                angles_deg(orientation(moved(now, motion, "rotvec")[3:])) - now[3:]
            )
        return np.append(motion, 1.0)

    def _pushed(self, now: Knot) -> tuple[NDArray[np.float64], float]:
        """Where target and surface are a tick from now."""
        layout = self.layout
        clear = not self.inside and now.pose[2] - now.surface_mm > _CLEAR_MM
        if self._due < len(layout.push_times_s) and self.time_s >= layout.push_times_s[self._due]:
            self._due += 1
            if clear and not self._pushing:
                self._place, self._pushing = self._place + 1, _PUSH_TICKS
        if not self._pushing:
            return now.target_mm, now.surface_mm
        share = 1 / self._pushing
        self._pushing -= 1
        target = now.target_mm + share * (layout.targets_mm[self._place] - now.target_mm)
        surface = now.surface_mm + share * (layout.surfaces_mm[self._place] - now.surface_mm)
        return target, float(surface)

    def _meet(self, before: Knot, now: Knot) -> NeedleContact:
        """Needle and tissue over one tick; also settles whether the tip is now inside."""
        part = np.arange(1, READINGS_PER_TICK + 1) / READINGS_PER_TICK
        tip = before.pose[2] + part * (now.pose[2] - before.pose[2])
        surface = before.surface_mm + part * (now.surface_mm - before.surface_mm)
        depth = surface - tip
        tissue = self.layout.tissue
        spring = tissue.spring_n(np.maximum(depth, 0))
        inside = self.inside | np.logical_or.accumulate(spring >= tissue.puncture_n)
        inside &= depth > 0
        self.inside = bool(inside[-1])
        return NeedleContact(
            distance_mm=np.maximum(-depth, 0),
            # A surface that gives way carries the layer along, until it is punctured.
            layer_mm=tissue.layer_depth_mm - np.where(inside, depth, np.minimum(depth, 0)),
            inside=inside,
            force_n=np.where(inside, tissue.drag_n(depth), spring),
        )
