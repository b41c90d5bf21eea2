"""What a policy remembers of one robot: its newest readings and features. Numpy only."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.source import CLOCK_SLACK_S

if TYPE_CHECKING:
    from pipeline.policy.policy import Policy


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


def older_than_trained(age_s: float, trained_age_s: float) -> bool:
    """Whether features are older than any in training, by over 10 %: clocks are not exact."""
    return age_s > 1.1 * trained_age_s


class RobotMemory:
    """The windows of one robot by stream, and its newest features."""

    def __init__(self, windows: Mapping[str, ReadingWindow]) -> None:
        self._windows = windows
        self.features: SeenFeatures | None = None
        self.time_s = 0.0

    @classmethod
    def of(cls, policy: "Policy") -> "RobotMemory":
        """An empty memory with the windows of this policy."""
        params, shape = policy.params, policy.shape
        sizes = {
            "sensor": (params.sensor_window, shape.sensor_channels, params.sensor_reach_s),
            "state": (params.state_readings, shape.state_dim, params.state_reach_s),
        }
        return cls({name: ReadingWindow(*size) for name, size in sizes.items() if size[1]})

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
            fields |= {
                "features": seen.features,
                "slot_valid": seen.slot_valid,
                "feature_age": np.array(np.nanmin(ages)),
                "view_age": ages,
            }
        return fields
