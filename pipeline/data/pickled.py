"""The recorder's old format: everything but the frames in a pickle, and no clock.

Row k of actions and sensor is at t0 + k / action_hz, t0 the earliest time in a frame's name.
"""

from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from pathlib import Path, PurePath, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import Source
from pipeline.base.errors import RecordingError
from pipeline.data.arrays import Numbers, number, numeric, read_npy
from pipeline.data.insertion import (
    SENSOR,
    InsertionRecording,
    promised,
    read_robot_states,
    robot_state_file,
    sensor_rows,
)
from pipeline.data.jpeg import frame_time, name_views, split_eye
from pipeline.data.plain_pickle import load_plain
from pipeline.data.recording import (
    Channels,
    Nominal,
    RecordedAction,
    Stream,
    checked_stream,
)

MARKER = "data.pkl"
_SENSOR_FILE = "sensor_data.npy"
_ACTION_HZ = 10.0
_ROBOT_HZ = 100.0
ACTION = Channels(
    ("dx", "dy", "dz", "da", "db", "dr", "gripper"), ("mm",) * 3 + ("deg",) * 3 + ("",)
)


def is_episode(folder: Path, names: Collection[str]) -> bool:
    """Whether a folder with these entries is an episode of the old format."""
    return MARKER in names


class PickledRecording(InsertionRecording):
    """An episode of the old format; the pickle is read on first use."""

    format = "old"

    def __init__(self, path: Path, source: Source, views: Sequence[str] | None) -> None:
        super().__init__(path, source, views)
        self._pickle = path / MARKER

    def action(self) -> RecordedAction:
        document = self._document()
        values = self._matrix(document, "action", len(ACTION.names))
        rate_hz = self._rate(document, "action_hz", _ACTION_HZ)
        time = self._start + np.arange(len(values)) / rate_hz
        stream = checked_stream(ACTION, time, values, f"{self._pickle}, 'action'")
        told = self._overrides.action_kind
        kind = "delta" if told == "auto" else told
        return RecordedAction(ACTION, stream.time, stream.values, kind, rate_hz)

    def sensor(self) -> Stream | None:
        document = self._document()
        values, where = self._sensor_values(document)
        if values is None:
            return None
        actions = len(self._matrix(document, "action", len(ACTION.names)))
        if len(values) != actions:
            raise RecordingError(
                f"{where}: {len(values)} sensor rows but {actions} actions; they must agree: "
                "both are recorded at action_hz"
            )
        rate_hz = self._rate(document, "action_hz", _ACTION_HZ)
        return checked_stream(SENSOR, self._start + np.arange(len(values)) / rate_hz, values, where)

    def state(self) -> Stream | None:
        path = robot_state_file(self.path)
        if path is None:
            return None
        rate_hz = self._rate(self._document(), "robot_hz", _ROBOT_HZ)
        return read_robot_states(path, self._start, rate_hz)

    def nominal(self) -> Nominal:
        """The streams that the pickle's metadata count; its rates are those of the clocks made."""
        metadata = self._metadata(self._document())
        told = promised(metadata, sensor=("has_sensor",), state=("num_robot_states",))
        return Nominal(streams=told, where=f"{MARKER}'s metadata")

    def _document(self) -> Mapping[str, Any]:
        # Not kept: thousands of episodes stay open, and each pickle carries its sensor rows.
        document = load_plain(self._pickle)
        if not isinstance(document, dict) or "action" not in document:
            found = ", ".join(map(str, document)) if isinstance(document, dict) else type(document)
            raise RecordingError(f"{self._pickle}: expected a dict with 'action', found {found}")
        return document

    def _matrix(self, document: Mapping[str, Any], key: str, width: int) -> NDArray[np.float32]:
        where = f"{self._pickle}, {key!r}"
        values = numeric(document[key], where)
        if values.ndim != 2 or values.shape[1] != width:
            raise RecordingError(f"{where}: expected shape (N, {width}), found {values.shape}")
        return np.asarray(values, np.float32)

    def _sensor_values(self, document: Mapping[str, Any]) -> tuple[Numbers | None, str]:
        sensor, where = document.get("sensor_data"), f"{self._pickle}, 'sensor_data'"
        if sensor is None:
            path = self.path / _SENSOR_FILE
            return (read_npy(path) if path.is_file() else None), str(path)
        if isinstance(sensor, dict):
            missing = [key for key in ("force", "fpi") if key not in sensor]
            if missing:
                raise RecordingError(f"{where}: no {' and no '.join(missing)} in {list(sensor)}")
            force, aline = (numeric(sensor[key], f"{where}, {key!r}") for key in ("force", "fpi"))
            return sensor_rows(force, aline, where), where
        return self._matrix(document, "sensor_data", len(SENSOR.names)), where

    def _rate(self, document: Mapping[str, Any], key: str, default: float) -> float:
        metadata = self._metadata(document)
        return number(metadata, key, f"{self._pickle}, 'metadata'", positive=True) or default

    def _metadata(self, document: Mapping[str, Any]) -> Mapping[str, Any]:
        metadata = document.get("metadata") or {}
        if not isinstance(metadata, dict):
            raise RecordingError(f"{self._pickle}: 'metadata' is a {type(metadata).__name__}")
        return metadata

    def _recorded_instruction(self) -> str:
        told = self._document().get("instruction")
        return told if isinstance(told, str) and told else super()._recorded_instruction()

    @cached_property
    def _start(self) -> float:
        frames = [_pure(path) for paths in self._recorded.values() for path in paths]
        return min(map(frame_time, frames), default=0.0)

    @cached_property
    def _recorded(self) -> Mapping[str, list[str]]:
        """Paths as recorded, by view name; a view with an empty list never came up."""
        recorded = self._document().get("image") or {}
        where = f"{self._pickle}, 'image'"
        if not isinstance(recorded, dict):
            raise RecordingError(f"{where}: expected paths by view, found {type(recorded)}")
        found: dict[tuple[str, str], list[str]] = {}
        for view, paths in recorded.items():
            if not isinstance(paths, list | tuple) or not all(isinstance(p, str) for p in paths):
                raise RecordingError(f"{where}, {view!r}: expected a list of paths")
            if paths:
                found[split_eye(str(view))] = list(paths)
        return name_views(found)

    def _locate(self, recorded: str, where: str) -> Path:
        """The file as recorded, else the longest tail of its path under this folder."""
        parts = _pure(recorded).parts
        absolute = Path(recorded)
        if absolute.is_absolute() and absolute.is_file():
            return absolute
        for depth in range(len(parts)):
            candidate = self.path / Path(*parts[depth:])
            if not Path(parts[depth]).is_absolute() and candidate.is_file():
                return candidate
        raise RecordingError(
            f"{where}: {recorded} is not there, nor is any tail of it under {self.path}; "
            "copy the frames beside data.pkl"
        )

    def all_views(self) -> Sequence[str]:
        return list(self._recorded)

    def _view_files(self) -> Mapping[str, list[Path]]:
        return {
            view: [
                self._locate(path, f"{self._pickle}, 'image', {view!r}, frame {frame}")
                for frame, path in enumerate(paths)
            ]
            for view, paths in self._recorded.items()
            if self._wants(view)
        }

    def _data_files(self) -> Sequence[Path | None]:
        return [self._pickle, self.path / _SENSOR_FILE, robot_state_file(self.path)]


def _pure(recorded: str) -> PurePath:
    return PureWindowsPath(recorded) if "\\" in recorded else PurePosixPath(recorded)
