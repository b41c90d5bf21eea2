"""The newest readings and features of one robot, as a policy takes them. Numpy only."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.clock import CLOCK_SLACK_S

if TYPE_CHECKING:
    from pipeline.policy.policy import Policy


@dataclass(frozen=True)
class WindowSize:
    """Of a stream's window: most readings, their channels, and how old they may be (None: any)."""

    readings: int
    channels: int
    oldest_s: float | None


class ReadingWindow:
    """The newest readings of a stream, right-aligned, in ring buffers that stay.

    Each buffer is kept twice in a row, so that the readings stand in order wherever they begin.
    """

    def __init__(self, size: WindowSize) -> None:
        self._readings = size.readings
        self._values = np.zeros((2, size.readings, size.channels), np.float32)
        self._time_s = np.full((2, size.readings), -np.inf)
        self._oldest = 0
        self._oldest_s = np.inf if size.oldest_s is None else size.oldest_s + CLOCK_SLACK_S

    @property
    def values(self) -> NDArray[np.float32]:
        """(reading, channel), oldest first: a view, as it is until the next `append`."""
        both = self._values.reshape(2 * self._readings, -1)
        return both[self._oldest : self._oldest + self._readings]

    @property
    def time_s(self) -> NDArray[np.float64]:
        """(reading,), as `values`; -inf where none has come yet."""
        return self._time_s.reshape(-1)[self._oldest : self._oldest + self._readings]

    def append(self, readings: NDArray[np.float32], time_s: NDArray[np.float64]) -> None:
        """Take the readings (reading, channel) that follow, and the times (reading,) of them."""
        for buffer, following in ((self._values, readings), (self._time_s, time_s)):
            newest = following[-self._readings :]
            to_end = newest[: self._readings - self._oldest]
            buffer[:, self._oldest : self._oldest + len(to_end)] = to_end
            buffer[:, : len(newest) - len(to_end)] = newest[len(to_end) :]
        self._oldest = (self._oldest + min(len(time_s), self._readings)) % self._readings

    def at(self, now_s: float) -> tuple[NDArray[np.float32], int, NDArray[np.float32]]:
        """The readings, how many of them are real, the last ones, and their ages in s."""
        age_s = now_s - self.time_s
        real = np.isfinite(age_s) & (age_s <= self._oldest_s)
        ages = np.where(real, age_s, 0).astype(np.float32)
        return self.values * real[:, None], int(real.sum()), ages


@dataclass(frozen=True)
class SeenFeatures:
    """Features (slot, dim), which of their slots are valid, and the time of each view's frame."""

    features: NDArray[np.float32]
    slot_valid: NDArray[np.bool_]
    frame_time_s: NDArray[np.float64]
    """(view,) in s, NaN of a missing one."""


class RobotMemory:
    """What a policy with windows of these sizes remembers of one robot."""

    def __init__(self, sensor: WindowSize, state: WindowSize) -> None:
        """Of a stream without channels nothing is remembered."""
        sizes = {"sensor": sensor, "state": state}
        self._windows = {name: ReadingWindow(size) for name, size in sizes.items() if size.channels}
        self.features: SeenFeatures | None = None
        self.time_s = 0.0

    @classmethod
    def of(cls, policy: "Policy") -> "RobotMemory":
        """That of a robot that this policy controls."""
        params, shape = policy.params, policy.shape
        return cls(
            WindowSize(params.sensor_window, shape.sensor_channels, params.sensor_reach_s),
            WindowSize(params.state_window, shape.state_dim, params.state_window_s),
        )

    def sense(self, readings: Mapping[str, NDArray[Any]]) -> None:
        """Take what came since the last tick, and `time` (1,) now, in s.

        `state` and `sensor` are (reading, channel); `state_time` and `sensor_time` (reading,).
        """
        self.time_s = float(readings["time"][0])
        for name, window in self._windows.items():
            if name in readings:
                window.append(readings[name], readings[f"{name}_time"])

    def observation(self) -> dict[str, NDArray[Any]]:
        """The fields of an `Observation` of one sample; features are missing until the first came.

        Ages are true ones: now, less the time of a reading or of a frame.
        """
        fields: dict[str, NDArray[Any]] = {}
        for name, window in self._windows.items():
            values, valid, ages = window.at(self.time_s)
            fields |= {name: values, f"{name}_valid": np.array(valid), f"{name}_age": ages}
        if (seen := self.features) is not None:
            ages = (self.time_s - seen.frame_time_s).astype(np.float32)
            fields |= {
                "features": seen.features,
                "slot_valid": seen.slot_valid,
                "feature_age": np.array(np.nanmin(ages)),
                "view_age": ages,
            }
        return fields
