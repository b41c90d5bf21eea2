"""The recorder's new format: sensor windows, an optional robot clock, `metadata.json`.

The windows may overlap or abut; `sensor()` rebuilds the stream that they were cut from.
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from pipeline.base.config import Source
from pipeline.base.errors import RecordingError
from pipeline.data.arrays import group_name, member, number, read_json, read_npz
from pipeline.data.insertion import (
    SENSOR,
    InsertionRecording,
    promised,
    read_robot_states,
    robot_state_file,
)
from pipeline.data.jpeg import list_empty_views, list_views
from pipeline.data.recording import Nominal, Stream, check_clock, checked_stream
from pipeline.data.windows import rebuild

MARKER = "metadata.json"
_SENSOR_FILE = "sensor_data.npz"
_LEFT_WITHOUT = frozenset({_SENSOR_FILE, "robot_states.npz"})
"""An episode that lost its metadata.json is reported, not passed over."""


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
        self._metadata = read_json(self._metadata_file)
        self._start = self._number("start_time")
        self._robot_hz = self._number("robot_hz", positive=True)
        self._sensor_hz = self._number("sensor_hz", positive=True)

    @property
    def group(self) -> str | None:
        return group_name(self._metadata, str(self._metadata_file))

    def state(self) -> Stream | None:
        path = robot_state_file(self.path)
        if path is None:
            return None
        end = self._number("end_time")
        stream = read_robot_states(path, self._start, self._robot_hz, end)
        self._check_count("robot_states_count", len(stream.time), path)
        return stream

    def sensor(self) -> Stream | None:
        path = self.path / _SENSOR_FILE
        if not path.is_file():
            return None
        members = read_npz(path, ("timestamps", "data"))
        ends = member(members, ("timestamps",), path)
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
        time, values = rebuild(ends, windows, self._sensor_hz, str(path))
        return checked_stream(SENSOR, time, values, str(path))

    def empty_views(self) -> Sequence[str]:
        return [view for view in list_empty_views(self.path / "images") if self._wants(view)]

    def nominal(self) -> Nominal:
        """Raises `RecordingError` where `metadata.json` counts frames in anything but a number."""
        rates = {"sensor": self._sensor_hz, "state": self._robot_hz}
        frames = self._number("camera_frames_count")
        listed = self._metadata.get("camera_views")
        return Nominal(
            rates_hz={name: rate for name, rate in rates.items() if rate is not None},
            streams=promised(
                self._metadata,
                sensor=("sensor_windows_count", "sensor_hz"),
                state=("robot_states_count", "robot_hz"),
            ),
            views=tuple(map(str, listed)) if isinstance(listed, list) else (),
            frames=None if frames is None else int(frames),
            where=MARKER,
        )

    def _recorded_instruction(self) -> str:
        told = self._metadata.get("instruction")
        return told if isinstance(told, str) and told else super()._recorded_instruction()

    def _number(self, key: str, *, positive: bool = False) -> float | None:
        return number(self._metadata, key, str(self._metadata_file), positive=positive)

    def _check_count(self, key: str, rows: int, path: Path) -> None:
        said = self._number(key)
        if said is not None and said != rows:
            raise RecordingError(
                f"{path}: {rows} rows, but {key} in {self._metadata_file} says {said:g}; "
                "they must agree: copy the episode again, or correct the metadata"
            )

    def _view_files(self) -> Mapping[str, list[Path]]:
        return list_views(self.path / "images")

    def _data_files(self) -> Sequence[Path | None]:
        return [self._metadata_file, self.path / _SENSOR_FILE, robot_state_file(self.path)]
