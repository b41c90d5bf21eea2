"""The limits of a robot's motion, workspace and force, from a YAML file. Numpy only.

Limits of motion (`step`, `speed`, `acceleration`) apply to each action before it is sent. Limits of
workspace and force apply to the readings of each tick, before anything is sent.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.channels import action_groups
from pipeline.base.config import LimitsFile, MotionLimit, load_section
from pipeline.base.errors import ConfigError
from pipeline.robot.loop import SafeStop, StopKind

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class _Bound:
    """How far some channels may move together in a tick, by one kind of limit."""

    kind: str
    name: str
    channels: list[int]
    most: float
    per_tick: float
    """`most` as a motion in one tick or, for an acceleration, as its change from tick to tick."""
    clips: bool


@dataclass(frozen=True)
class _Range:
    """The lowest and the highest allowed reading of a channel."""

    stream: str
    name: str
    channel: int
    low: float
    high: float


class Limits:
    """The limits of a file for a robot of this metadata, and the action that was sent last.

    `hz` is the number of actions a second. Raises `ConfigError` for a channel that the robot does
    not have, and for a motion limit on an absolute channel that the state does not have: it is
    unknown how far the first action moves such a channel.
    """

    def __init__(self, file: LimitsFile, metadata: Mapping[str, Any], hz: float) -> None:
        self.hz = hz
        self._streams: Mapping[str, Any] = metadata["streams"]
        action = self._streams["action"]
        self._names = list(action["names"])
        self._absolute = ~np.asarray(metadata["moving"], np.bool_)
        self._goes_on = ~self._absolute & (action["kind"] == "velocity")
        self._per_tick = np.where(self._goes_on, 1 / hz, 1.0)
        self._state_of = [self._place("state", name) for name in self._names]
        self.clipped = 0
        """Ticks in which an action was clipped."""
        rates = {"step": 1.0, "speed": hz, "acceleration": hz * hz}
        self._bounds = [
            bound
            for kind, rate in rates.items()
            if (limit := getattr(file, kind)) is not None
            for bound in self._motion(kind, limit, rate)
        ]
        box = file.workspace.box if file.workspace else {}
        force = file.force.most if file.force else {}
        self._ranges = [
            self._range("state", f"workspace.box.{name}", name, *low_high)
            for name, low_high in box.items()
        ] + [
            self._range("sensor", f"force.most.{name}", name, -most, most)
            for name, most in force.items()
        ]
        self.reset()

    @classmethod
    def read(cls, path: Path, metadata: Mapping[str, Any], hz: float) -> "Limits":
        """The limits of a YAML file. Raises `ConfigError` that names file and key."""
        file = load_section(path, LimitsFile)
        try:
            return cls(file, metadata, hz)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from None

    @property
    def streams(self) -> set[str]:
        """The streams whose readings these limits need."""
        follows = any(self._absolute[bound.channels].any() for bound in self._bounds)
        return {bound.stream for bound in self._ranges} | ({"state"} if follows else set())

    def reset(self) -> None:
        """Begin again: the robot stands still at the position of its next reading."""
        self._reference = np.full(len(self._names), np.nan)
        self._moved, self._sent = np.zeros(len(self._names)), False

    def check(self, observed: Mapping[str, NDArray[Any]]) -> None:
        """Raise `SafeStop` for readings outside the workspace or of too much force."""
        for bound in self._ranges:
            readings = observed.get(bound.stream)
            if readings is None or not len(readings):
                continue
            values = readings[:, bound.channel]
            low, high = float(values.min()), float(values.max())
            if low < bound.low or high > bound.high:
                kind = StopKind.WORKSPACE if bound.stream == "state" else StopKind.FORCE
                beyond = low if low < bound.low else high
                within = f"{bound.low:g} to {bound.high:g}"
                raise SafeStop(kind, f"{bound.name} measured at {beyond:g}, allowed are {within}")
        if not self._sent and len(observed.get("state", ())):
            newest = observed["state"][-1]
            held = [np.nan if at is None else float(newest[at]) for at in self._state_of]
            self._reference = np.array(held)

    def allow(self, action: Vector) -> Vector:
        """The action (action,), clipped to the limits; the same array if it is within them.

        Raises `SafeStop` for a motion beyond a limit that stops, or beyond any limit after another
        limit has clipped it.
        """
        absolute, at = self._absolute, self._reference
        wanted = np.where(absolute, action - at, action * self._per_tick)
        moved = wanted
        for bound in self._bounds:
            moved = self._bounded(moved, bound, bound.clips)
        if moved is not wanted:
            for bound in self._bounds:  # A later clip may have undone an earlier one.
                self._bounded(moved, bound, clips=False)
            self.clipped += 1
            sent = np.where(absolute, at + moved, moved / self._per_tick)
            action = np.where(np.isnan(sent), action, sent)
        self._moved, self._reference = moved, np.where(absolute, action, at)
        self._sent = True
        return action

    def stood_still(self) -> None:
        """Note that nothing was sent for a tick or more; velocity channels moved on meanwhile."""
        self._moved = np.where(self._goes_on, self._moved, 0.0)

    def _bounded(self, moved: Vector, bound: _Bound, clips: bool) -> Vector:
        before = self._moved if bound.kind == "acceleration" else np.zeros_like(moved)
        change = (moved - before)[bound.channels]
        length = float(np.linalg.norm(change))
        if np.isnan(length):
            raise SafeStop(StopKind.STALLED, f"no reading says where {bound.name} begins")
        if not length > bound.per_tick * (1 + 1e-6):
            return moved
        if not clips:
            size = bound.most * length / bound.per_tick
            why = f"{bound.kind} of {bound.name} would be {size:.4g}, at most {bound.most:g}"
            raise SafeStop(StopKind.LIMIT, why)
        clipped = moved.copy()
        clipped[bound.channels] = before[bound.channels] + change * (bound.per_tick / length)
        return clipped

    def _motion(self, kind: str, limit: MotionLimit, rate: float) -> list[_Bound]:
        action = self._streams["action"]
        groups = action_groups(self._names, action["units"])
        bounds: list[_Bound] = []
        for name, most in limit.most.items():
            among = groups if name in ("translation", "rotation") else self._names
            channels = [i for i, own in enumerate(among) if own == name]
            where = f"{kind}.most.{name}"
            if not channels:
                known = ["translation", "rotation", *self._names]
                raise ConfigError(
                    f"{where}: the action has no such channel; it has {', '.join(known)}"
                )
            for i in channels:
                if self._absolute[i] and self._state_of[i] is None:
                    raise ConfigError(
                        f"{where}: {self._names[i]} says where to be, and the state has no channel "
                        "of that name that says where it is. Limit it by workspace.box, or name "
                        "the state's channels as the action's."
                    )
            clips = limit.on_exceed == "clip"
            bounds.append(_Bound(kind, name, channels, most, most / rate, clips))
        return bounds

    def _range(self, stream: str, where: str, name: str, low: float, high: float) -> _Range:
        channel = self._place(stream, name)
        if channel is None:
            known = ", ".join(self._streams[stream]["names"][:12]) or "none"
            raise ConfigError(f"{where}: the {stream} has no such channel; it has {known} …")
        if low >= high:
            raise ConfigError(f"{where}: expected the lowest and the highest, found {low}, {high}")
        return _Range(stream, name, channel, low, high)

    def _place(self, stream: str, name: str) -> int | None:
        names = self._streams[stream]["names"]
        return names.index(name) if name in names else None
