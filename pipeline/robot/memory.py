"""The newest readings and features of one robot, as a policy takes them. Numpy only."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


class ReadingWindow:
    """The newest `size` readings of a stream, right-aligned, in one buffer that stays."""

    def __init__(self, size: int, channels: int) -> None:
        self.values = np.zeros((size, channels), np.float32)
        self.valid = 0
        """How many of them are real, the last ones."""

    def append(self, readings: NDArray[np.float32]) -> None:
        """Take the readings (reading, channel) that follow."""
        newest = readings[-len(self.values) :]
        kept = len(self.values) - len(newest)
        self.values[:kept] = self.values[len(newest) :]
        self.values[kept:] = newest
        self.valid = min(len(self.values), self.valid + len(newest))


@dataclass(frozen=True)
class SeenFeatures:
    """Features (slot, dim), which of their slots are valid, and the time of their newest frame."""

    features: NDArray[np.float32]
    slot_valid: NDArray[np.bool_]
    frame_time_s: float


class RobotMemory:
    """What a policy with windows of these sizes remembers of one robot."""

    def __init__(self, sensor: tuple[int, int], state: tuple[int, int]) -> None:
        """`sensor` and `state` are (readings, channels) of the windows; without channels none."""
        sizes = {"sensor": sensor, "state": state}
        self._windows = {name: ReadingWindow(*size) for name, size in sizes.items() if size[1]}
        self.features: SeenFeatures | None = None
        self.time_s = 0.0

    def sense(self, readings: Mapping[str, NDArray[Any]]) -> None:
        """Take what came since the last tick: `state`, `sensor`, and `time` (1,) now, in s."""
        self.time_s = float(readings["time"][0])
        for name, window in self._windows.items():
            if name in readings:
                window.append(readings[name])

    def observation(self) -> dict[str, NDArray[Any]]:
        """The fields of an `Observation` of one sample; features are missing until the first came.

        `feature_age` is the true one: now, less the time of their newest frame.
        """
        fields: dict[str, NDArray[Any]] = {}
        for name, window in self._windows.items():
            fields[name] = window.values.copy()
            fields[f"{name}_valid"] = np.array(window.valid)
        if (seen := self.features) is not None:
            fields |= {
                "features": seen.features,
                "slot_valid": seen.slot_valid,
                "feature_age": np.array(self.time_s - seen.frame_time_s, np.float32),
            }
        return fields
