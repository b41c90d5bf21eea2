"""The recorder's new format: sensor windows, an optional robot clock, `metadata.json`.

The recorder cuts windows at a fixed stride and stamps each with the time of its last reading.
Windows overlap, abut or have gaps; `rebuild` restores the stream from which they were cut. The
recorder's clock jitters, so the stride from the clock is checked against the overlapping data.
"""

import os
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.base.config import Source
from pipeline.base.documents import Text
from pipeline.base.errors import RecordingError
from pipeline.data.arrays import Numbers, member, read_npz
from pipeline.data.insertion import (
    SENSOR,
    InsertionRecording,
    read_robot_states,
    robot_state_file,
)
from pipeline.data.jpeg import list_views, split_eye
from pipeline.data.recording import (
    RECORDINGS,
    Grouped,
    Rate,
    Seconds,
    Stream,
    check_clock,
    check_resolution,
    checked_stream,
)

MARKER = "metadata.json"
_SENSOR_FILE = "sensor_data.npz"
_LEFT_WITHOUT = frozenset({_SENSOR_FILE, "robot_states.npz"})
"""Files that mark a folder without metadata.json as a broken episode, which is reported."""
_OVERLAP = 0.75
"""Windows certainly overlap if the clock advances by less than this fraction of a window."""
_PAIRS_SAMPLED = 16
_SHIFTS_TRIED = 32
"""Most shifts that are compared, the nearest to the expected stride first: readings agree at one
shift or, if they are constant, at all shifts."""

_Count = Annotated[int, Field(ge=0, le=10**9)]


class _Metadata(Grouped):
    start_time: Seconds | None = None
    end_time: Seconds | None = None
    robot_hz: Rate | None = None
    sensor_hz: Rate | None = None
    robot_states_count: _Count | None = None
    sensor_windows_count: _Count | None = None
    camera_views: tuple[Text, ...] | None = None
    instruction: Text | None = None


def is_episode(folder: Path, names: Collection[str]) -> bool:
    """Whether a folder with these entries is of the new format, with or without its metadata."""
    return MARKER in names or ("data.pkl" not in names and not _LEFT_WITHOUT.isdisjoint(names))


class WindowedRecording(InsertionRecording):
    """An episode of the new format."""

    format = "new"

    def __init__(self, path: Path, source: Source, views: Sequence[str] | None) -> None:
        """Raises `RecordingError` where `metadata.json` cannot be read."""
        super().__init__(path, source, views)
        self._metadata_file = path / MARKER
        self._metadata = RECORDINGS.read_json(self._metadata_file, _Metadata)

    @property
    def group(self) -> str | None:
        return self._metadata.group_name

    def state(self) -> Stream | None:
        path, metadata = robot_state_file(self.path), self._metadata
        if path is None:
            return self._check_count("robot_states_count", 0, self.path / "robot_states.npz")
        times = (metadata.start_time, metadata.robot_hz, metadata.end_time)
        stream = read_robot_states(path, self._overrides.limits, *times)
        self._check_count("robot_states_count", len(stream.time), path)
        return stream

    def sensor(self) -> Stream | None:
        path = self.path / _SENSOR_FILE
        if not os.path.lexists(path):
            return self._check_count("sensor_windows_count", 0, path)
        members = read_npz(path, ("timestamps", "data"), limits=self._overrides.limits)
        stored = member(members, ("timestamps",), path)
        ends = stored.astype(np.float64)
        windows = member(members, ("data",), path)
        if windows.ndim != 3 or windows.shape[2] != len(SENSOR.names) or not windows.shape[1]:
            raise RecordingError(
                f"{path}: expected windows (N, W, {len(SENSOR.names)}), found {windows.shape}"
            )
        if ends.shape != (len(windows),):
            raise RecordingError(
                f"{path}: {len(windows)} windows but {ends.size} timestamps; they must agree"
            )
        self._check_count("sensor_windows_count", len(windows), path)
        if not len(windows):
            return None
        check_clock(ends, f"{path}, member 'timestamps'")
        check_resolution(stored, f"{path}, member 'timestamps'")
        if (sensor_hz := self._metadata.sensor_hz) is None:
            raise RecordingError(f"{self._metadata_file}: windows need a sensor_hz; add it")
        time, values = rebuild(ends, windows, sensor_hz, str(path))
        return checked_stream(SENSOR, time, values, str(path))

    def _recorded_instruction(self) -> str:
        return self._metadata.instruction or super()._recorded_instruction()

    def _check_count(self, key: str, rows: int, path: Path) -> None:
        count = getattr(self._metadata, key)
        if count not in (None, rows):
            raise RecordingError(
                f"{path}: {rows} rows, but {key} in {self._metadata_file} says {count}; "
                "they must agree: copy the episode again, or correct the metadata"
            )

    def _view_files(self) -> Mapping[str, list[Path]]:
        views, listed = list_views(self.path / "images"), self._metadata.camera_views or ()
        recorded = {split_eye(view)[0] for view in views}
        lost = [view for view in listed if self._wants(view) and split_eye(view)[0] not in recorded]
        if lost:
            raise RecordingError(
                f"{self._metadata_file}: camera_views has {', '.join(lost)}, and images/ no frame "
                "of it. Copy the episode again, or correct the metadata"
            )
        return views

    def _data_files(self) -> Sequence[Path | None]:
        return [self._metadata_file, self.path / _SENSOR_FILE, robot_state_file(self.path)]


def rebuild(
    ends: NDArray[np.float64], windows: Numbers, sensor_hz: float, where: str
) -> tuple[NDArray[np.float64], Numbers]:
    """Clock (reading,) s and readings (reading, channel) without the duplicates.

    `ends` (window,) s never decreases; `windows` is (window, reading, channel). Readings are spread
    evenly between the ends of windows that overlap or abut; after a gap, and in the first window,
    they are dated back from the end at `sensor_hz`. Raises `RecordingError` where windows overlap
    by the clock but their readings differ, as those with NaN do.
    """
    width = windows.shape[1]
    fresh = np.array([width, *_strides(ends, windows, sensor_hz, where)])
    usual = np.median(fresh[1:]) if len(ends) > 1 else width
    times = [ends[0] - np.arange(width)[::-1] / sensor_hz]
    for previous, end, count in zip(ends[:-1], ends[1:], fresh[1:], strict=True):
        missing = (end - previous) * sensor_hz - count
        if missing > 0.5 * min(usual, count):
            times.append(end - np.arange(count)[::-1] / sensor_hz)
        else:
            times.append(previous + (end - previous) * np.arange(1, count + 1) / max(count, 1))
    values = [window[width - count :] for window, count in zip(windows, fresh, strict=True)]
    return np.concatenate(times), np.concatenate(values)


def _strides(
    ends: NDArray[np.float64], windows: Numbers, sensor_hz: float, where: str
) -> list[int]:
    """How many new readings each window after the first has."""
    width = windows.shape[1]
    if len(ends) < 2:
        return []
    expected = np.diff(ends) * sensor_hz
    proved = _proved_stride(windows)
    # A reading that the sensor repeats looks like an overlap of windows that abut by the clock.
    # Gaps change the mean step, and stamps in bursts the median; one of the two must agree.
    steps = (float(np.median(expected)), float(expected.mean()))
    abut = abs(steps[0] - width) <= 0.1 * width
    if proved and not abut and all(abs(step - proved) > 0.1 * proved for step in steps):
        raise RecordingError(
            f"{where}: expected windows to advance by {max(steps):.4g} readings by the clock and "
            f"sensor_hz {sensor_hz:g} in {MARKER}, found {proved} by their readings; sensor_hz "
            f"{proved * sensor_hz / (max(steps) or np.inf):.4g} would fit: correct the metadata"
        )
    typical = float(np.median(expected))
    usual = proved or min(round(typical), width)
    overlapping = typical < _OVERLAP * width
    strides: list[int] = []
    for index, step in enumerate(expected, start=1):
        near = usual if abs(step - typical) <= 0.5 * typical else float(step)
        previous, window = windows[index - 1], windows[index]
        shifts = sorted([*_first_rows(previous, window), width], key=lambda s: abs(s - near))
        stride = next(
            s for s in (*shifts[:_SHIFTS_TRIED], width) if s == width or _agree(previous, window, s)
        )
        if stride == width and overlapping and step < _OVERLAP * width:
            raise RecordingError(
                f"{where}: windows {index - 1} and {index} overlap by the clock (stride "
                f"{step:.0f} of {width} readings), but no shift of their readings agrees; "
                "check timestamps and sensor_hz"
            )
        strides.append(stride)
    return strides


def _proved_stride(windows: Numbers) -> int | None:
    """The stride at which most of the sampled window pairs agree; None if they do not show one."""
    sampled = np.unique(np.linspace(1, len(windows) - 1, _PAIRS_SAMPLED).astype(int))
    votes: Counter[int] = Counter()
    for index in sampled:
        previous, window = windows[index - 1], windows[index]
        shifts = _first_rows(previous, window)
        # Readings that do not change agree at every shift and prove nothing.
        if len(shifts) == 1 and _agree(previous, window, shifts[0]):
            votes[shifts[0]] += 1
    stride, count = max(votes.items(), key=lambda vote: vote[1], default=(0, 0))
    return stride if 2 * count > len(sampled) else None


def _first_rows(previous: Numbers, window: Numbers) -> Sequence[int]:
    """The rows of the previous window that equal this window's first reading."""
    same = np.flatnonzero(previous[:, 0] == window[0, 0])
    return [int(row) for row in same if np.array_equal(previous[row], window[0])]


def _agree(previous: Numbers, window: Numbers, stride: int) -> bool:
    return np.array_equal(previous[stride:], window[: len(window) - stride])
