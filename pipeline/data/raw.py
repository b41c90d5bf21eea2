"""The recorder's raw format: every stream with its own clock.

`robot_state_<tag>.csv`, `sensor_data_<tag>.npz` and `View1..5/` (or `View1/left/`) of JPEGs.
"""

from collections.abc import Collection, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path

from pipeline.base.config import Source
from pipeline.base.errors import RecordingError
from pipeline.data.arrays import member, read_npz
from pipeline.data.insertion import SENSOR, InsertionRecording, read_state_csv, sensor_rows
from pipeline.data.jpeg import list_views
from pipeline.data.recording import Stream, checked_stream

_STATE_FILES = "robot_state_*.csv"
_SENSOR_FILES = "sensor_data_*.npz"
MARKER = f"{_STATE_FILES} and {_SENSOR_FILES}"


def is_episode(folder: Path, names: Collection[str]) -> bool:
    """Whether a folder with these entries is a raw episode."""
    return any(fnmatch(name, _STATE_FILES) or fnmatch(name, _SENSOR_FILES) for name in names)


class RawRecording(InsertionRecording):
    """A raw episode; `origin_timestamp` and the sensor's `timestamps` are its clocks."""

    format = "raw"

    def __init__(self, path: Path, source: Source, views: Sequence[str] | None) -> None:
        """Raises `RecordingError` unless there is one state file and at most one sensor file."""
        super().__init__(path, source, views)
        state_file = self._only(_STATE_FILES)
        if state_file is None:
            raise RecordingError(
                f"{path}: expected one {_STATE_FILES}, found none; "
                "was the folder copied completely?"
            )
        self._state_file = state_file
        self._sensor_file = self._only(_SENSOR_FILES)

    @property
    def has_poses(self) -> bool:
        return True

    def state(self) -> Stream:
        return read_state_csv(self._state_file)

    def sensor(self) -> Stream | None:
        path = self._sensor_file
        if path is None:
            return None
        wanted = ("timestamps", "forces", "force", "alines", "aline")
        members = read_npz(path, wanted, limits=self._overrides.limits)
        values = sensor_rows(
            member(members, ("forces", "force"), path),
            member(members, ("alines", "aline"), path),
            str(path),
        )
        return checked_stream(SENSOR, member(members, ("timestamps",), path), values, str(path))

    def _only(self, pattern: str) -> Path | None:
        files = sorted(self.path.glob(pattern))
        if len(files) > 1:
            raise RecordingError(
                f"{self.path}: expected one {pattern}, found {', '.join(p.name for p in files)}; "
                "leave the right one and move the others away"
            )
        return files[0] if files else None

    def _view_files(self) -> Mapping[str, list[Path]]:
        return list_views(self.path, prefix="View")

    def _data_files(self) -> Sequence[Path | None]:
        return [self._state_file, self._sensor_file]
