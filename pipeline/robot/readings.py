"""A robot's readings, its clock, and what a policy remembers of it. Numpy only.

`PendingReadings` and `RobotClock` check what a robot gives before it goes to the policy.
`RobotMemory` has the newest readings and features of one robot, as the policy takes them.
"""

import math
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.provenance import CLOCK_SLACK_S
from pipeline.robot.loop import SafeStop, StopKind

if TYPE_CHECKING:
    from pipeline.policy.policy import Policy

_FIRST_OBSERVATIONS = 10
"""The number of observations over which the offset of the robot's clock is measured."""


class PendingReadings:
    """The readings of a stream since the last question, but only the newest `most` of them."""

    def __init__(self, most: int, channels: int) -> None:
        self.channels = channels
        self._pending: deque[tuple[NDArray[np.float32], float]] = deque(maxlen=most)
        self.newest_s: float | None = None
        """Time of the newest reading of the episode; None before the first."""

    def __len__(self) -> int:
        return len(self._pending)

    def forget(self) -> None:
        """Begin a new episode."""
        self._pending.clear()
        self.newest_s = None

    def append(
        self, name: str, values: NDArray[Any], time_s: NDArray[Any], latest_s: float
    ) -> None:
        """Add readings (reading, channel) and their times (reading,), at least one.

        Raises `SafeStop` for one that is not a number, is not in order, or is later than
        `latest_s`.
        """
        if not (np.isfinite(values).all() and np.isfinite(time_s).all()):
            raise SafeStop(StopKind.NOT_A_NUMBER, f"{name}: a reading or its time is not a number")
        before = -math.inf if self.newest_s is None else self.newest_s
        if time_s[0] < before or (np.diff(time_s) < 0).any():
            raise SafeStop(StopKind.CLOCK, f"{name}: a reading is older than the one before it")
        if time_s[-1] > latest_s:
            ahead = time_s[-1] - latest_s
            raise SafeStop(StopKind.CLOCK, f"{name}: a reading is of the future, by {ahead:.3f} s")
        self.newest_s = float(time_s[-1])
        self._pending.extend(zip(np.array(values, np.float32), map(float, time_s), strict=True))

    def hand_over(self) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Return the pending readings and their times, and remove them from here."""
        values, times = zip(*self._pending, strict=True)
        self._pending.clear()
        return np.stack(values), np.array(times)


class RobotClock:
    """The robot's clock compared with `time.monotonic()`: its offset is set once, then watched.

    A clock that is 50 ppm off drifts by 0.1 s, the default of `drift_s`, in some 33 minutes. For
    longer runs synchronize the clocks (NTP, PTP), let the robot use `time.monotonic()`, or allow
    more drift.
    """

    def __init__(self, drift_s: float) -> None:
        self._drift_s, self._seen = drift_s, 0
        self.offset_s = -math.inf

    def now_s(self) -> float:
        """The time on the robot's clock, if it has kept its offset."""
        return time.monotonic() + self.offset_s

    def check(self, time_s: float) -> None:
        """Check a time that the robot just gave; raises `SafeStop` if the offset has moved."""
        offset = time_s - time.monotonic()
        self._seen += 1
        if self._seen <= _FIRST_OBSERVATIONS:
            # The observation that took the least time to arrive gives the truest offset.
            self.offset_s = max(self.offset_s, offset)
        moved = offset - self.offset_s
        if not abs(moved) <= self._drift_s:
            why = f"the robot's clock is {moved:+.3f} s from where it was"
            raise SafeStop(StopKind.CLOCK, why)


class ReadingWindow:
    """The newest readings of a stream (reading, channel) and their times (reading,), oldest first.

    Readings stand at the end; before the first one values are 0 and times -inf.
    """

    def __init__(self, readings: int, channels: int, oldest_s: float | None) -> None:
        """A reading older than `oldest_s` is not valid; None allows any age."""
        self.values = np.zeros((readings, channels), np.float32)
        self.time_s = np.full(readings, -np.inf)
        self._oldest_s = np.inf if oldest_s is None else oldest_s + CLOCK_SLACK_S

    def append(self, readings: NDArray[np.float32], time_s: NDArray[np.float64]) -> None:
        """Add the next readings (reading, channel) and their times (reading,)."""
        kept = len(self.time_s)
        self.values = np.concatenate([self.values, readings], dtype=np.float32)[-kept:]
        self.time_s = np.concatenate([self.time_s, time_s])[-kept:]

    def at(self, now_s: float) -> tuple[NDArray[np.float32], int, NDArray[np.float32]]:
        """The readings, how many at the end are valid, and the ages in s; both 0 if not valid."""
        age_s = now_s - self.time_s
        valid = np.isfinite(age_s) & (age_s <= self._oldest_s)
        ages = np.where(valid, age_s, 0).astype(np.float32)
        return self.values * valid[:, None], int(valid.sum()), ages


@dataclass(frozen=True)
class SeenFeatures:
    """Features (slot, dim), which of their slots are valid, and the time of each view's frame."""

    features: NDArray[np.float32]
    slot_valid: NDArray[np.bool_]
    frame_time_s: NDArray[np.float64]
    """(view,) in s, NaN for a missing view."""
    key: bytes = b""
    """`row_key` of the frames and prompt; empty unless a session computed the features."""


class RobotMemory:
    """The windows of one robot by stream, and its newest features."""

    def __init__(self, windows: Mapping[str, ReadingWindow], history: int = 1) -> None:
        """With `history`, the policy sees the features of that many passes of the model."""
        self._windows = windows
        self._seen: deque[SeenFeatures] = deque(maxlen=history)
        self.time_s = 0.0

    @property
    def features(self) -> SeenFeatures | None:
        """The newest features; None until the first came."""
        return self._seen[0] if self._seen else None

    @features.setter
    def features(self, seen: SeenFeatures) -> None:
        self._seen.appendleft(seen)

    def forget_features(self) -> None:
        """Forget all features: what follows belongs to another prompt."""
        self._seen.clear()

    @classmethod
    def of(cls, policy: "Policy") -> "RobotMemory":
        """An empty memory with the windows of this policy."""
        params, shape = policy.params, policy.shape
        sizes = {
            "sensor": (params.sensor_window, shape.sensor_channels, params.sensor_reach_s),
            "state": (params.state_readings, shape.state_dim, params.state_reach_s),
        }
        windows = {name: ReadingWindow(*size) for name, size in sizes.items() if size[1]}
        return cls(windows, shape.history)

    def sense(self, readings: Mapping[str, NDArray[Any]]) -> None:
        """Take the readings since the last tick, and `time` (1,) now, in s.

        `state` and `sensor` are (reading, channel), `state_time` and `sensor_time` (reading,). A
        stream that the policy does not have is ignored.
        """
        self.time_s = float(readings["time"][0])
        for name, window in self._windows.items():
            if name in readings:
                window.append(readings[name], readings[f"{name}_time"])

    def observation(self) -> dict[str, NDArray[Any]]:
        """The fields of an `Observation` of one sample, without features until the first came.

        An age is the current time minus the time of the reading or frame.
        """
        fields: dict[str, NDArray[Any]] = {}
        for name, window in self._windows.items():
            values, valid, ages = window.at(self.time_s)
            fields |= {name: values, f"{name}_valid": np.array(valid), f"{name}_age": ages}
        if (seen := self.features) is not None:
            ages = (self.time_s - seen.frame_time_s).astype(np.float32)
            features, valid = seen.features, seen.slot_valid
            if (history := self._seen.maxlen or 1) > 1:
                rows = [*self._seen, *[self._seen[-1]] * (history - len(self._seen))]
                features = np.concatenate([row.features for row in rows])
                valid = np.concatenate([row.slot_valid for row in rows])
            fields |= {
                "features": features,
                "slot_valid": valid,
                "feature_age": np.array(np.nanmin(ages)),
                "view_age": ages,
            }
        return fields
