"""The recorder's new format: sensor windows, an optional robot clock, `metadata.json`.

The windows may overlap or abut; `sensor()` rebuilds the stream that they were cut from.
"""

import os
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from pipeline.base.border import Text
from pipeline.base.config import Source
from pipeline.base.errors import RecordingError
from pipeline.data.arrays import member, read_npz
from pipeline.data.insertion import (
    SENSOR,
    InsertionRecording,
    promised,
    read_robot_states,
    robot_state_file,
)
from pipeline.data.jpeg import list_empty_views, list_views, split_eye
from pipeline.data.media import RECORDINGS, Grouped, Rate, Seconds
from pipeline.data.recording import Nominal, Stream, check_clock, check_resolution, checked_stream
from pipeline.data.windows import rebuild

MARKER = "metadata.json"
_SENSOR_FILE = "sensor_data.npz"
_LEFT_WITHOUT = frozenset({_SENSOR_FILE, "robot_states.npz"})
"""Files by which an episode that lost its metadata.json is reported, not passed over."""

_Count = Annotated[int, Field(ge=0, le=10**9)]


class _Metadata(Grouped):
    start_time: Seconds | None = None
    end_time: Seconds | None = None
    robot_hz: Rate | None = None
    sensor_hz: Rate | None = None
    robot_states_count: _Count | None = None
    sensor_windows_count: _Count | None = None
    camera_frames_count: _Count | None = None
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
        path = robot_state_file(self.path)
        if path is None:
            return None
        metadata = self._metadata
        times = (metadata.start_time, metadata.robot_hz, metadata.end_time)
        stream = read_robot_states(path, self._overrides.limits, *times)
        self._check_count("robot_states_count", len(stream.time), path)
        return stream

    def sensor(self) -> Stream | None:
        path = self.path / _SENSOR_FILE
        if not os.path.lexists(path):
            return None
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
        time, values = rebuild(ends, windows, self._metadata.sensor_hz, str(path))
        return checked_stream(SENSOR, time, values, str(path))

    def empty_views(self) -> Sequence[str]:
        return [view for view in list_empty_views(self.path / "images") if self._wants(view)]

    def nominal(self) -> Nominal:
        rates = {"sensor": self._metadata.sensor_hz, "state": self._metadata.robot_hz}
        known = {name: rate for name, rate in rates.items() if rate is not None}
        streams = promised(
            self._metadata,
            sensor=("sensor_windows_count", "sensor_hz"),
            state=("robot_states_count", "robot_hz"),
        )
        return Nominal(known, streams, MARKER)

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
        views, metadata = list_views(self.path / "images"), self._metadata
        there = {split_eye(view)[0] for view in views}
        listed = {split_eye(view)[0] for view in metadata.camera_views or () if self._wants(view)}
        most = max(map(len, views.values()), default=0)
        if lost := sorted(listed - there):
            what = f"camera_views has {', '.join(lost)}, and images/ no frame of it"
        elif self._views is None and most < (metadata.camera_frames_count or 0):
            what = f"camera_frames_count is {metadata.camera_frames_count}, and images/ has {most}"
        else:
            return views
        raise RecordingError(
            f"{self._metadata_file}: {what}. Copy the episode again, or correct the metadata"
        )

    def _data_files(self) -> Sequence[Path | None]:
        return [self._metadata_file, self.path / _SENSOR_FILE, robot_state_file(self.path)]
