"""A robot's readings before they go to the policy, and its clock; both are checked. Numpy only."""

import math
import time
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.robot.loop import SafeStop, StopKind

_FIRST_OBSERVATIONS = 10
"""The number of observations over which the offset of the robot's clock is measured."""


class PendingReadings:
    """The readings of a stream since the last question, but only the newest `most` of them."""

    def __init__(self, most: int, channels: int) -> None:
        self.channels, self.dropped = channels, 0
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
        total = len(self._pending) + len(time_s)
        self._pending.extend(zip(np.array(values, np.float32), map(float, time_s), strict=True))
        self.dropped += total - len(self._pending)

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

    def __init__(self, offset_s: float | None, drift_s: float) -> None:
        """`offset_s` is the robot's clock minus ours; with None it is measured."""
        self._declared, self._drift_s = offset_s, drift_s
        self.offset_s = -math.inf if offset_s is None else offset_s
        self._seen = 0

    def now_s(self) -> float:
        """The time on the robot's clock, if it has kept its offset."""
        return time.monotonic() + self.offset_s

    def check(self, time_s: float) -> None:
        """Check a time that the robot just gave; raises `SafeStop` if the offset has moved."""
        offset = time_s - time.monotonic()
        self._seen += 1
        if self._declared is None and self._seen <= _FIRST_OBSERVATIONS:
            # The observation that took the least time to arrive gives the truest offset.
            self.offset_s = max(self.offset_s, offset)
        moved = offset - self.offset_s
        if not abs(moved) <= self._drift_s:
            why = f"the robot's clock is {moved:+.3f} s from where it was"
            raise SafeStop(StopKind.CLOCK, why)
