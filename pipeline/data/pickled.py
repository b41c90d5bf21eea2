"""The recorder's old format: a pickle with everything but the frames, and no clock.

Row k of actions and sensor is at t0 + k / action_hz; t0 is the earliest time in a frame's name.

A pickle names functions and classes, and an unpickler calls them. `load_plain` knows only the names
needed for arrays, numpy scalars, bytes and sets, and replaces each with a function of its own that
checks its arguments. It refuses any other name before it looks it up.
"""

import os
import pickle
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path, PurePath, PurePosixPath, PureWindowsPath
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator, InstanceOf, Strict

from pipeline.base.config import Source
from pipeline.base.documents import Document, Text, shown
from pipeline.base.errors import RecordingError
from pipeline.base.provenance import ViewName
from pipeline.data.arrays import Numbers, numeric, read_npy
from pipeline.data.insertion import (
    SENSOR,
    InsertionRecording,
    read_robot_states,
    robot_state_file,
    sensor_rows,
)
from pipeline.data.jpeg import frame_time, name_views, split_eye
from pipeline.data.recording import (
    RECORDINGS,
    Channels,
    Rate,
    RecordedAction,
    Stream,
    check_limit,
    checked_stream,
)

MARKER = "data.pkl"
_SENSOR_FILE = "sensor_data.npy"
_ACTION_HZ = 10.0
_ROBOT_HZ = 100.0
ACTION = Channels(
    ("dx", "dy", "dz", "da", "db", "dr", "gripper"), ("mm",) * 3 + ("deg",) * 3 + ("",)
)
_DTYPE = re.compile(r"[<>=|]?(\?|[biuf][1248]|[SU]\d{1,6})")
_PickledArray = Annotated[InstanceOf[np.ndarray], AfterValidator(np.asarray)]


class _Metadata(Document):
    action_hz: Rate | None = None
    robot_hz: Rate | None = None


class _Readings(Document):
    force: _PickledArray
    """(N, 1)."""
    fpi: _PickledArray
    """(N, 1025)."""


class _Content(Document):
    """What `data.pkl` holds."""

    action: _PickledArray
    """(N, 7)."""
    sensor_data: _PickledArray | _Readings | None = None
    """(N, 1026), or its two parts."""
    image: dict[ViewName, Annotated[list[Text], Strict(False)]] | None = None
    """Paths as recorded, by view."""
    instruction: Text | None = None
    metadata: Annotated[_Metadata, BeforeValidator(lambda entries: entries or {})] = _Metadata()


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
        content = self._content
        values = self._rows(content.action, "action", len(ACTION.names))
        rate_hz = content.metadata.action_hz or _ACTION_HZ
        time = self._start + np.arange(len(values)) / rate_hz
        stream = checked_stream(ACTION, time, values, f"{self._pickle}, 'action'")
        kind = self._overrides.action_kind
        kind = "delta" if kind == "auto" else kind
        return RecordedAction(ACTION, stream.time, stream.values, kind, rate_hz)

    def sensor(self) -> Stream | None:
        content = self._read()
        values, where = self._sensor_values(content)
        if values is None:
            return None
        actions = len(self._rows(content.action, "action", len(ACTION.names)))
        if len(values) != actions:
            raise RecordingError(
                f"{where}: {len(values)} sensor rows but {actions} actions; they must agree: "
                "both are recorded at action_hz"
            )
        rate_hz = content.metadata.action_hz or _ACTION_HZ
        return checked_stream(SENSOR, self._start + np.arange(len(values)) / rate_hz, values, where)

    def state(self) -> Stream | None:
        path = robot_state_file(self.path)
        if path is None:
            return None
        rate_hz = self._content.metadata.robot_hz or _ROBOT_HZ
        return read_robot_states(path, self._overrides.limits, self._start, rate_hz)

    @cached_property
    def _content(self) -> _Content:
        """What is kept: all but the sensor's readings, as thousands of episodes stay open."""
        return self._read().model_copy(update={"sensor_data": None})

    def _read(self) -> _Content:
        loaded = load_plain(self._pickle, self._overrides.limits.array_bytes)
        return RECORDINGS.parse(loaded, _Content, self._pickle)

    def _rows(self, array: Numbers, key: str, width: int) -> Numbers:
        where = f"{self._pickle}, {key!r}"
        if numeric(array, where).ndim != 2 or array.shape[1] != width:
            raise RecordingError(f"{where}: expected shape (N, {width}), found {array.shape}")
        return array

    def _sensor_values(self, content: _Content) -> tuple[Numbers | None, str]:
        sensor, where = content.sensor_data, f"{self._pickle}, 'sensor_data'"
        if sensor is None:
            path = self.path / _SENSOR_FILE
            exists = os.path.lexists(path)
            return read_npy(path, self._overrides.limits) if exists else None, str(path)
        if isinstance(sensor, _Readings):
            force, fpi = numeric(sensor.force, where), numeric(sensor.fpi, where)
            return sensor_rows(force, fpi, where), where
        return self._rows(sensor, "sensor_data", len(SENSOR.names)), where

    def _recorded_instruction(self) -> str:
        return self._content.instruction or super()._recorded_instruction()

    @cached_property
    def _start(self) -> float:
        frames = [_pure(path) for paths in self._recorded.values() for path in paths]
        return min(map(frame_time, frames), default=0.0)

    @cached_property
    def _recorded(self) -> Mapping[str, list[str]]:
        """Recorded paths by view name; a view with an empty list was never captured."""
        recorded = self._content.image or {}
        return name_views({split_eye(view): paths for view, paths in recorded.items() if paths})

    def _locate(self, recorded: str, where: str) -> Path:
        """The file at its recorded path, or at the longest tail of it under this folder."""
        # Only the last parts of the path can exist under the episode's folder.
        parts = _pure(recorded).parts[-10:]
        for tail in (Path(recorded), *(Path(*parts[first:]) for first in range(len(parts)))):
            candidate = self.path / tail  # the tail itself if it is absolute
            inside = tail.is_absolute() or ".." not in tail.parts
            if inside and os.path.isfile(candidate):  # noqa: PTH113, a name may be too long
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


class _Refused(Exception):
    """The pickle asks for something that is not allowed; other errors mean damage."""


class _Dtype:
    """Replaces `numpy.dtype`, whose own state could turn numbers into pointers."""

    def __init__(self, code: Any, *_: Any) -> None:
        if not isinstance(code, str) or not _DTYPE.fullmatch(code):
            raise _Refused(f"an array of dtype {shown(code)}")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        self.dtype = self.dtype.newbyteorder(state[1])


class _Array(np.ndarray):
    """An array whose state follows it in the pickle, as in protocols below 5."""

    def __setstate__(self, state: Any, /) -> None:
        _, shape, dtype, fortran, data = state
        super().__setstate__((1, shape, dtype.dtype, fortran, data))


def _frombuffer(data: Any, dtype: _Dtype, shape: Any, order: str, axes: Any = None) -> Any:
    if not isinstance(data, bytes | bytearray):  # an array would share its memory
        raise _Refused("an array that shares the memory of another")
    array = np.frombuffer(data, dtype.dtype).reshape(shape, order="F" if order == "F" else "C")
    return array if axes is None else array.transpose(axes)


_CALLS: dict[str, Callable[..., Any]] = {
    "numpy.dtype": _Dtype,
    "numpy._core.multiarray._reconstruct": lambda *_: np.empty(0, np.int8).view(_Array),
    "numpy._core.multiarray.scalar": lambda dtype, data: np.frombuffer(data, dtype.dtype)[0].item(),
    "numpy._core.numeric._frombuffer": _frombuffer,
    "collections.OrderedDict": dict,
    "builtins.set": set,
    "builtins.frozenset": frozenset,
}
"""The functions that replace the names in a pickle."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str, /) -> Any:
        known = f"{module}.{name}".replace("numpy.core.", "numpy._core.")  # numpy 1
        if known == "numpy.ndarray":  # an argument of _reconstruct, never called
            return None
        if known not in _CALLS:
            raise _Refused(shown(known).strip("'"))
        # A pickle can set attributes of a named object, so it gets a new one each time.
        return partial(_CALLS[known])


def load_plain(path: Path, most: int) -> Any:
    """The content of a pickle of numpy arrays, scalars, dicts, lists, tuples, sets and text.

    Numpy scalars become plain numbers. Raises `RecordingError`, and executes nothing, where the
    pickle asks for anything else (as protocols below 3 do), is damaged, or has more than `most`
    bytes.
    """
    check_limit(path, RECORDINGS.check_file(path), most, "array_bytes", "bytes")
    # Damaged bytes make numpy and the unpickler raise almost any exception.
    with RECORDINGS.foreign(path, "damaged pickle"), path.open("rb") as file:
        try:
            return _Unpickler(file, encoding="latin1").load()
        except _Refused as error:
            raise RECORDINGS.refusal(
                path,
                f"refused: it asks for {error}; only numpy arrays and plain containers are "
                "admitted, because a pickle can run code. Nothing was executed",
            ) from None
