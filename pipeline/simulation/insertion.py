"""The physics of a simulated needle insertion, one step for each control tick.

A six-axis arm carries a needle over a soft phantom. A sticker on the phantom marks where to enter;
a layer inside the phantom is where to stop. Each stream shows only a part of this:

- The bench is at another place in every episode, and the cameras are fixed to it: the arm's pose
  says nothing about the target. Only the images show the target's sideways position.
- The cameras show no heights (`Scene` has none). Only the A-scan shows the distances to tissue and
  layer, and only the force shows contact.
- The phantom breathes. At level `moved` it is also pushed aside and up or down at random times, as
  a patient moves, but only while the needle is clear of it: past motion does not predict the next.

An action is added to the commanded setpoint of the arm, not to the arm's pose: the arm follows with
a lag, at limited speed and acceleration (`arm.ArmMotion`).

Mechanics along the needle (vertical; leans are small): tissue is a stiffening spring,
f = k1·u + k2·u² for an indentation u, until it is punctured at a set force; the surface then
springs back around the needle, and f = cutting + friction·depth, as in A. M. Okamura, C. Simone,
M. D. O'Leary, "Force modeling for needle insertion into soft tissue", IEEE TBME 51(10), 2004.
A needle inside is held where it entered: a sideways pull meets a spring, which also presses the
needle against its channel and so adds friction along it. Pushes that are due while the needle is
near or inside do not happen; bending is not modelled.

Between ticks target and surface move in straight lines. Units: mm, degrees, N, s. `bench` frame:
the base frame moved sideways to the bench.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import Level
from pipeline.data.timeline import ActionRotation, wrapped_deg
from pipeline.simulation.arm import ArmMotion, angles_deg, moved, orientation, robot_state
from pipeline.simulation.demonstrator import REACTION_TICKS, expert_motion
from pipeline.simulation.insertion_layout import InsertionLayout, draw_layout
from pipeline.simulation.needle_sensor import READING_HZ, NeedleContact, NeedleSensor

TICK_HZ: Final = 10
TICK_S: Final = 1 / TICK_HZ
READINGS_PER_TICK: Final = READING_HZ // TICK_HZ
STATE_HZ: Final = 100
HUB_MM: Final = 8.0
"""Height of the needle's hub above its tip."""
ENCODER_NOISE: Final = 0.002
"""Standard deviation of every joint and pose reading, mm and degrees."""

MISS_MM: Final = 1.0
"""Largest sideways distance from the target to the puncture."""
AT_LAYER_MM: Final = 0.15
"""Largest distance from the layer to a tip that counts as resting at it."""
HOLD_TICKS: Final = 6
"""Ticks for which the tip has to rest at the layer."""
OVERSHOOT_MM: Final = 0.5
"""Largest distance that the tip may go beyond the layer."""
FORCE_LIMIT_N: Final = 2.5
"""Largest force on the needle."""
MAX_TICKS: Final = 120
"""Ticks within which the needle has to be inserted: 12 s."""

_PUSH_TICKS = 2
_CLEAR_MM = 1.1
"""The phantom is pushed only while the tip is farther away than this."""
_SIDEWAYS_N_MM, _SIDEWAYS_FRICTION = 0.8, 0.3
"""Spring that holds a needle 1 mm or more inside, and the friction that its force causes."""


@dataclass(frozen=True)
class Scene:
    """Everything that the cameras see, in the bench frame: no heights.

    `needle_mm` (2,) is the tip, `lean_mm` (2,) the hub's sideways distance from it, `target_mm`
    (2,) the target.
    """

    needle_mm: NDArray[np.float64]
    lean_mm: NDArray[np.float64]
    target_mm: NDArray[np.float64]
    brightness: float


@dataclass(frozen=True)
class Knot:
    """Where everything is at the end of a tick.

    `motion` is the arm's motion during the tick; `pose` (6,) is in the base frame, its angles not
    wrapped; `target_mm` (2,) is in the bench frame; `surface_mm` is the height of the undisturbed
    surface in the base frame; `layer_mm` is from the tip to the layer, and `force_n` is the largest
    force of the tick.
    """

    motion: ArmMotion
    pose: NDArray[np.float64]
    target_mm: NDArray[np.float64]
    surface_mm: float
    layer_mm: float = np.nan
    force_n: float = 0.0


@dataclass
class Progress:
    """What decides whether an episode succeeds, fails or goes on."""

    puncture_mm: NDArray[np.float64] | None = None
    """(2,) sideways from the target to the tip, when the surface was last punctured."""
    overshoot_mm: float = 0.0
    max_force_n: float = 0.0
    held_ticks: int = 0

    def outcome(self, ticks: int) -> str | None:
        """Why the episode ended after `ticks`, `INSERTED` for success; None where it goes on."""
        if self.max_force_n > FORCE_LIMIT_N:
            return "too much force"
        if self.puncture_mm is not None and np.hypot(*self.puncture_mm) > MISS_MM:
            return "punctured beside the target"
        if self.overshoot_mm > OVERSHOOT_MM:
            return "beyond the layer"
        if self.held_ticks >= HOLD_TICKS:
            return INSERTED
        if ticks < MAX_TICKS:
            return None
        return TIME_IS_UP if self.puncture_mm is not None else f"{TIME_IS_UP} before a puncture"


INSTRUCTION: Final = "Insert the needle at the red point"
INSERTED: Final = "inserted"
TIME_IS_UP: Final = "time is up"


@dataclass(frozen=True)
class InsertionTrace:
    """The course of an insertion, one row for each tick.

    `time_s` (tick,). `offset_mm` (tick, 2) is sideways from the target to the tip; `lateral_mm`
    (2,) is the offset at the puncture, or at the end without one. `height_mm` (tick,) is of the tip
    above the surface at rest, negative inside. `layer_mm` (tick,) is from the tip to the target
    layer, negative beyond it. `force_n` (tick,) is the largest within the tick.
    """

    time_s: NDArray[np.float64]
    offset_mm: NDArray[np.float64]
    lateral_mm: NDArray[np.float64]
    height_mm: NDArray[np.float64]
    layer_mm: NDArray[np.float64]
    force_n: NDArray[np.float64]


class NeedleInsertion:
    """A needle insertion to step through: `reset`, then `step` until `finished`.

    A policy may see `state` (10, 12) and `sensor` (65, 1026), the readings of the tick that ends
    now, and what `rendering.photograph` shows. The same seed and actions give the same readings,
    bit for bit. `action_rotation` is the convention of an action's rotation channels.
    """

    state: NDArray[np.float32]
    sensor: NDArray[np.float32]
    layout: InsertionLayout
    knots: list[Knot]
    progress: Progress

    def __init__(self, action_rotation: ActionRotation = "rotvec") -> None:
        self.action_rotation: ActionRotation = action_rotation

    def reset(self, seed: int, level: Level = "full") -> None:
        """Begin the episode of this seed."""
        self.start(draw_layout(seed, level))

    def start(self, layout: InsertionLayout) -> None:
        """Begin the episode of this layout: the arm stands still for one tick."""
        self.layout = layout
        self._upright = orientation(layout.upright_deg)
        self._sensor = NeedleSensor(layout.oct_gain, layout.seed)
        self.inside, self.progress, self.setpoint = False, Progress(), layout.start_pose
        surface = layout.surfaces_mm[0] + layout.breath_mm(0.0)
        resting = ArmMotion.resting(layout.start_pose)
        self.knots = [Knot(resting, layout.start_pose, layout.targets_mm[0], surface)]
        self._place, self._pushing, self._due = 0, 0, 0
        self._entry_mm = layout.start_pose[:2]
        self.step(np.zeros(7))

    @property
    def time_s(self) -> float:
        """Seconds since the episode began."""
        return (len(self.knots) - 1) * TICK_S

    @property
    def outcome(self) -> str | None:
        """Why the episode has ended, `INSERTED` for success; None where it goes on."""
        return self.progress.outcome(len(self.knots) - 1)

    @property
    def finished(self) -> bool:
        """Whether the needle is inserted, a limit was passed, or time is up."""
        return self.outcome is not None

    def step(self, action: NDArray[np.float64]) -> None:
        """Carry out one tick: dx dy dz (mm, base frame), rotation (deg), gripper (ignored).

        The action is added to the commanded setpoint, which the arm follows. Raises `ValueError`
        for an action that is not seven finite numbers.
        """
        if np.shape(action) != (7,) or not np.isfinite(action).all():
            raise ValueError(f"action: expected 7 finite numbers, found {action}")
        now = self.knots[-1]
        self.setpoint = moved(self.setpoint, np.asarray(action, np.float64), self.action_rotation)
        motion = now.motion.towards(self.setpoint, TICK_S)
        target, surface = self._pushed(now)
        self.contact, path = self._meet(now, motion, target, surface)
        layer, force = float(self.contact.layer_mm[-1]), float(self._force_n.max())
        self.knots.append(Knot(motion, path[-1], target, surface, layer, force))
        progress = self.progress
        resting = self.inside and abs(layer) < AT_LAYER_MM
        progress.held_ticks = progress.held_ticks + 1 if resting else 0
        progress.max_force_n = max(progress.max_force_n, force)
        if self.contact.inside.any():
            beyond = -self.contact.layer_mm[self.contact.inside].min()
            progress.overshoot_mm = max(progress.overshoot_mm, float(beyond))
        self._measure()

    def _measure(self) -> None:
        rng = np.random.default_rng([self.layout.seed, 101, len(self.knots) - 1])
        times = np.arange(1, STATE_HZ // TICK_HZ + 1) / STATE_HZ
        state = robot_state(self.knots[-1].motion.at(times))
        noise = ENCODER_NOISE * rng.standard_normal(state.shape)
        self.state = (state + noise).astype(np.float32)
        self.sensor = self._sensor.read(self.contact, self.time_s - TICK_S, rng)

    def poses(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """True poses (time, 6) at any times of the episode so far, angles not wrapped."""
        motions = [knot.motion for knot in self.knots[1:]]
        at = np.clip(time_s * TICK_HZ, 0, len(motions))
        tick = np.minimum(at.astype(np.int64), len(motions) - 1)
        fields = [[motion.pose, motion.reference, motion.velocity] for motion in motions]
        return ArmMotion(*np.stack(fields, axis=1)[:, tick]).at((at - tick) * TICK_S)

    def scene(self, time_s: float) -> Scene:
        """The scene at a time of the episode so far."""
        at = min(max(time_s * TICK_HZ, 0.0), len(self.knots) - 1.0)
        first = min(int(at), len(self.knots) - 2)
        before, after = self.knots[first : first + 2]
        pose = after.motion.at(np.array([(at - first) * TICK_S]))[0]
        upward = (orientation(pose[3:]) * self._upright.inv()).apply([0.0, 0.0, HUB_MM])
        return Scene(
            needle_mm=pose[:2] - self.layout.bench_mm,
            lean_mm=upward[:2],
            target_mm=before.target_mm + (at - first) * (after.target_mm - before.target_mm),
            brightness=self.layout.brightness,
        )

    def trace(self) -> InsertionTrace:
        """The course of the episode so far."""
        knots = self.knots[1:]
        bench, puncture = self.layout.bench_mm, self.progress.puncture_mm
        offsets = np.stack([knot.pose[:2] - bench - knot.target_mm for knot in knots])
        return InsertionTrace(
            time_s=np.arange(1.0, len(self.knots)) * TICK_S,
            offset_mm=offsets,
            lateral_mm=offsets[-1] if puncture is None else puncture,
            height_mm=np.array([knot.pose[2] - knot.surface_mm for knot in knots]),
            layer_mm=np.array([knot.layer_mm for knot in knots]),
            force_n=np.array([knot.force_n for knot in knots]),
        )

    def expert_action(self) -> NDArray[np.float64]:
        """The demonstrator's next action (7,), in the convention of `step`; gripper 1."""
        before, now = self.knots[-2].pose, self.knots[-1].pose
        seen = self.knots[max(0, len(self.knots) - 1 - REACTION_TICKS)]
        spun = (orientation(now[3:]) * orientation(before[3:]).inv()).as_rotvec(degrees=True)
        motion = expert_motion(
            offset_mm=seen.target_mm - (now[:2] - self.layout.bench_mm),
            distance_mm=float(now[2]) - self.knots[-1].surface_mm,
            layer_mm=self.knots[-1].layer_mm,
            inside=self.inside,
            turn_deg=(self._upright * orientation(now[3:]).inv()).as_rotvec(degrees=True),
            velocity=np.concatenate([now[:3] - before[:3], spun]),
            speed_mm_s=self.layout.speed_mm_s,
            tick_s=TICK_S,
            rng=np.random.default_rng([self.layout.seed, 102, len(self.knots)]),
        )
        if self.action_rotation == "euler_delta":
            motion[3:] = wrapped_deg(
                angles_deg(orientation(moved(now, motion, "rotvec")[3:])) - now[3:]
            )
        return np.append(motion, 1.0)

    def _pushed(self, now: Knot) -> tuple[NDArray[np.float64], float]:
        """The target and the height of the surface a tick from now."""
        layout, breath = self.layout, self.layout.breath_mm(self.time_s + TICK_S)
        calm = now.surface_mm - layout.breath_mm(self.time_s)
        clear = not self.inside and now.pose[2] - now.surface_mm > _CLEAR_MM
        if self._due < len(layout.push_times_s) and self.time_s >= layout.push_times_s[self._due]:
            self._due += 1
            if clear and not self._pushing:
                self._place, self._pushing = self._place + 1, _PUSH_TICKS
        if not self._pushing:
            return now.target_mm, calm + breath
        share = 1 / self._pushing
        self._pushing -= 1
        target = now.target_mm + share * (layout.targets_mm[self._place] - now.target_mm)
        return target, calm + share * float(layout.surfaces_mm[self._place] - calm) + breath

    def _meet(
        self, before: Knot, motion: ArmMotion, target_mm: NDArray[np.float64], surface_mm: float
    ) -> tuple[NeedleContact, NDArray[np.float64]]:
        """The contact of needle and tissue over one tick, and the poses at its readings.

        It also decides whether the tip is now inside, where it entered, and the force on it.
        """
        part = np.arange(1, READINGS_PER_TICK + 1) / READINGS_PER_TICK
        path = motion.at(part * TICK_S)
        depth = before.surface_mm + part * (surface_mm - before.surface_mm) - path[:, 2]
        tissue = self.layout.tissue
        spring = tissue.spring_n(np.maximum(depth, 0))
        inside = self.inside | np.logical_or.accumulate(spring >= tissue.puncture_n)
        inside &= depth > 0
        if inside.any() and not self.inside:
            entered = int(inside.argmax())
            self._entry_mm = path[entered, :2]
            target = before.target_mm + part[entered] * (target_mm - before.target_mm)
            self.progress.puncture_mm = self._entry_mm - self.layout.bench_mm - target
        self.inside = bool(inside[-1])
        held = np.where(inside, np.clip(depth, 0, 1), 0) * _SIDEWAYS_N_MM
        sideways = held * np.hypot(*(path[:, :2] - self._entry_mm).T)
        drag = tissue.drag_n(depth) + _SIDEWAYS_FRICTION * sideways
        contact = NeedleContact(
            distance_mm=np.maximum(-depth, 0),
            # An indented surface moves the layer along, until it is punctured.
            layer_mm=tissue.layer_depth_mm - np.where(inside, depth, np.minimum(depth, 0)),
            inside=inside,
            force_n=np.where(inside, drag, spring),
        )
        self._force_n = np.hypot(contact.force_n, sideways)
        return contact, path
