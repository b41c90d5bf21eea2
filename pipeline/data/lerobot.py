"""LeRobot data sets v2.0, v2.1 and v3.0: state and action from parquet, frames from video.

Rows and frames pair by number; the `timestamp` column is the clock, as `lerobot_clock` reads it.
What has no home in LeRobot lies in this project's sidecars, beside the data set's own folders:
`sensor/episode_000003.npz` a high-rate sensor, `state/…` states that are faster than the rows,
`frames/…` when the images in the rows were captured.
"""

import json
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.base.config import Source
from pipeline.base.errors import RecordingError
from pipeline.data.arrays import member, read_npz
from pipeline.data.insertion import SENSOR
from pipeline.data.lerobot_clock import NUMBERS, check_numbers, read_clock, stored_clock
from pipeline.data.lerobot_layout import LeRobotEntry, LeRobotLayout, read_layout
from pipeline.data.lerobot_rows import ParquetCamera, find_rows, matrix
from pipeline.data.reader import FileRecording
from pipeline.data.recording import (
    ActionKind,
    CameraStream,
    Channels,
    Nominal,
    RecordedAction,
    Stream,
    checked_stream,
)
from pipeline.data.video import VideoClip

MARKER = "meta/info.json"
STATE = "observation.state"
ACTION = "action"
KIND = "kind"
"""Under which key the feature of the actions says of which kind they are: this project's."""
_DESCRIBING = ("dtype", "names", "units")
_SIDECARS = ("sensor", "state", "frames")
_DELTA = re.compile(r"delta.*|d(x|y|z|a|b|r|rx|ry|rz|alpha|beta|gamma|roll|pitch|yaw)")


def is_root(folder: Path, names: Collection[str]) -> bool:
    """Whether a folder with these entries is a LeRobot data set."""
    return "meta" in names and (folder / MARKER).is_file()


def open_data_set(
    root: Path, source: Source, views: Sequence[str] | None
) -> tuple[list["LeRobotRecording"], list[str]]:
    """The episodes whose files are there, and a line for each that `meta/` lists and has none.

    Raises `RecordingError` where `meta/` is broken, and where `views` names a depth map.
    """
    layout, entries = read_layout(root)
    if asked := [view for view in layout.depth if view in (views or ())]:
        raise RecordingError(
            f"{root / MARKER}: data.views asks for {', '.join(asked)}, but is_depth_map is true "
            "there: a depth map is no picture that the model can be shown. Leave it out of "
            "data.views"
        )
    there: dict[Path, bool] = {}
    recordings: list[LeRobotRecording] = []
    missing: list[str] = []
    for entry in entries:
        recording = LeRobotRecording(layout, entry, source, views)
        absent = next(
            (p for p in recording.listed_files() if not there.setdefault(p, p.is_file())), None
        )
        if absent is None:
            recordings.append(recording)
        else:
            said = f"{absent} is not there: copy it again, or go on without"
            missing.append(f"{source.name}: {root} lists {entry.id}, but {said}")
    return recordings, missing


class LeRobotRecording(FileRecording):
    """One episode of a LeRobot data set; `path` is the data set's root."""

    format = "lerobot"

    def __init__(
        self,
        layout: LeRobotLayout,
        entry: LeRobotEntry,
        source: Source,
        views: Sequence[str] | None,
    ) -> None:
        super().__init__(layout.root, source, views)
        self.id = entry.id
        self._layout = layout
        self._entry = entry

    @property
    def group(self) -> str | None:
        return self._entry.group

    def listed_files(self) -> list[Path]:
        """The data file and the wanted views' videos, as `meta/` names them."""
        keys = [key for view, key in self._layout.views.items() if self._wants(view)]
        videos = [self._entry.videos[key].path for key in keys if key in self._entry.videos]
        return [self._entry.data, *videos]

    def files(self) -> list[Path]:
        _, *videos = self.listed_files()
        sidecars = [path for name in _SIDECARS if (path := self._sidecar(name)) is not None]
        return sorted({find_rows(self._layout, self._entry).path, *videos, *sidecars})

    def identity(self) -> str:
        """What `meta/info.json` decides, and where the shared files of v3.0 hold the episode.

        Not the whole of `meta/`, which changes whenever an episode is added.
        """
        features = {
            name: {key: self._layout.features[name].get(key) for key in _DESCRIBING}
            for name in self._read_features()
        }
        described = json.dumps(
            {"fps": self._layout.fps, "features": features}, sort_keys=True, separators=(",", ":")
        )
        if (kind := self._layout.features.get(ACTION, {}).get(KIND)) is not None:
            described += f" {KIND}={kind}"
        self._check_spans()
        where, table = self._numbers(())
        if not np.array_equal(self._clock(where, table), stored_clock(table, where)):
            # Stores from before clocks were made exact hold other times of the same files.
            described += " clock=frame_index/fps"
        if not self._entry.shared:
            return described
        spans = {view: self._entry.videos.get(key) for view, key in self._layout.views.items()}
        frames = [f"{v}@{span.first}" for v, span in sorted(spans.items()) if span]
        return " ".join([described, f"{self._entry.id}+{self._entry.length}", *frames])

    def _read_features(self) -> list[str]:
        kept = [key for view, key in self._layout.views.items() if self._wants(view)]
        return [*(name for name in (STATE, ACTION) if name in self._layout.features), *kept]

    def state(self) -> Stream | None:
        if (path := self._sidecar("state")) is not None:
            return _sidecar_stream(path)
        return self._stream(STATE) if STATE in self._layout.features else None

    def action(self) -> RecordedAction:
        if ACTION not in self._layout.features:
            raise RecordingError(
                f"{self.path / MARKER}: no feature {ACTION!r}; "
                f"it has {', '.join(self._layout.features)}"
            )
        stream = self._stream(ACTION)
        told = self._overrides.action_kind
        kind = self._action_kind(stream.channels.names) if told == "auto" else told
        return RecordedAction(stream.channels, stream.time, stream.values, kind, self._layout.fps)

    def sensor(self) -> Stream | None:
        path = self._sidecar("sensor")
        return None if path is None else _sidecar_stream(path)

    def nominal(self) -> Nominal:
        clocks = ["action"]
        if self._sidecar("state") is None:
            clocks.append("state")
        if self._sidecar("frames") is None:
            clocks += [f"view {view}" for view in self.all_views()]
        mistakes = self._misplaced_rows()
        return Nominal(dict.fromkeys(clocks, self._layout.fps), where=MARKER, mistakes=mistakes)

    def _misplaced_rows(self) -> tuple[str, ...]:
        """What `meta/` says wrongly of the file of v3.0 that holds the rows."""
        rows, named = find_rows(self._layout, self._entry).path, self._entry.data
        if rows == named:
            return ()
        told, there = (path.relative_to(self.path).as_posix() for path in (named, rows))
        return (
            f"meta/episodes says that the rows of {self._entry.id} lie in {told}, they lie in "
            f"{there} and were read there; other readers may miss them. Correct its "
            "data/chunk_index and data/file_index, or convert the data set again with lerobot "
            "0.5.0 or later (up to 0.4.4 it wrote such entries)",
        )

    def all_views(self) -> Sequence[str]:
        return sorted(self._layout.views)

    def depth_views(self) -> Sequence[str]:
        return sorted(view for view in self._layout.depth if self._wants(view))

    def _recorded_instruction(self) -> str:
        if len(self._entry.tasks) == 1:
            return self._entry.tasks[0]
        rows = find_rows(self._layout, self._entry)
        where, table = f"{rows.path}, {self._entry.id}", rows.columns(("task_index",))
        if "task_index" not in table.column_names:
            raise RecordingError(f"{where}: no column task_index, and meta/ names no one task")
        asked = [int(index) for index in np.unique(table["task_index"].to_numpy())]
        texts = [self._layout.task_text.get(index) for index in asked]
        if len(texts) != 1 or texts[0] is None:
            raise RecordingError(
                f"{where}: expected one task that meta/ knows, found task_index {asked}: {texts}; "
                f"give source {self.source!r} an `instruction`"
            )
        return texts[0]

    def _cameras(self) -> Mapping[str, CameraStream]:
        wanted = {v: key for v, key in self._layout.views.items() if self._wants(v)}
        if not wanted:
            return {}
        self._check_spans()
        time = self._clock(*self._numbers())
        rows = find_rows(self._layout, self._entry)
        videos, fps = self._entry.videos, self._layout.fps
        captured = self._captured([view for view, key in wanted.items() if key not in videos])
        return {
            view: VideoClip(view, time, videos[key], fps)
            if key in videos
            else ParquetCamera(view, time, rows, key, captured.get(view))
            for view, key in sorted(wanted.items())
        }

    def _captured(self, views: Sequence[str]) -> Mapping[str, NDArray[np.float64]]:
        """Of the views that the sidecar knows: (row,) s when each row's image was captured."""
        path = self._sidecar("frames")
        return {} if path is None or not views else read_npz(path, views)

    def _action_kind(self, names: Sequence[str]) -> ActionKind:
        """What the feature says itself, else what its channels' names say."""
        kind = self._layout.features[ACTION].get(KIND)
        if kind is None:
            return action_kind(names)
        if kind not in get_args(ActionKind):
            raise RecordingError(
                f"{self.path / MARKER}, {ACTION!r}: expected {KIND} to be one of "
                f"{', '.join(get_args(ActionKind))}, found {kind!r}. Correct it, or set the "
                "source's action_kind"
            )
        return kind

    def _stream(self, name: str) -> Stream:
        where, table = self._numbers()
        channels = _channels(name, self._layout.features[name], f"{self.path / MARKER}, {name!r}")
        values = matrix(_column(table, name, where), len(channels.names), f"{where}, {name!r}")
        return checked_stream(
            channels, self._clock(where, table), values.astype(np.float32), f"{where}, {name!r}"
        )

    def _check_spans(self) -> None:
        for view, key in self._layout.views.items():
            span = self._entry.videos.get(key)
            if span is not None and span.rival and self._wants(view):
                raise RecordingError(
                    f"{span.path}: meta/ gives frames of {key!r} from {span.first} on to "
                    f"{self._entry.id} and to {span.rival} too, so file_index or from_timestamp of "
                    "one is wrong. Correct meta/episodes, write the data set again, or leave both "
                    "episodes or the view out (data.on_bad_episode: skip, data.views)"
                )

    def _clock(self, where: str, table: pa.Table) -> NDArray[np.float64]:
        return read_clock(table, self._layout.fps, where)

    def _numbers(self, streams: Sequence[str] = (STATE, ACTION)) -> tuple[str, pa.Table]:
        """The episode's rows of these streams with their clock, known to be its own."""
        rows = find_rows(self._layout, self._entry)
        table = rows.columns((*NUMBERS, *streams))
        check_numbers(table, rows, self._entry)
        return f"{rows.path}, {self._entry.id}", table

    def _sidecar(self, name: str) -> Path | None:
        """The episode's file of that name, where there is one."""
        # Not `self.id`, before which parent folders may stand.
        path = self.path / name / f"{self._entry.id}.npz"
        return path if path.is_file() else None


def action_kind(names: Sequence[str]) -> ActionKind:
    """What the names of the action's channels say; absolute where they say nothing."""
    lower = [name.lower() for name in names]
    if any("vel" in name for name in lower):
        return "velocity"
    return "delta" if any(_DELTA.fullmatch(name) for name in lower) else "absolute"


def _sidecar_stream(path: Path) -> Stream:
    """The stream of a file with `timestamps` and `values`, and perhaps `names` and `units`."""
    members = read_npz(path, ("timestamps", "values"), text=("names", "units"))
    values = member(members, ("values",), path)
    if values.ndim != 2:
        raise RecordingError(f"{path}: expected values (N, channel), found {values.shape}")
    channels = _sidecar_channels(members, values.shape[1], path)
    return checked_stream(channels, member(members, ("timestamps",), path), values, str(path))


def _column(table: pa.Table, name: str, where: str) -> pa.ChunkedArray:
    if name not in table.column_names:
        raise RecordingError(f"{where}: missing column {name!r}")
    return table[name]


def _channels(name: str, feature: Mapping[str, Any], where: str) -> Channels:
    """The channels of a feature; `units` beside `names` is this project's extension."""
    shape = feature.get("shape")
    if not isinstance(shape, list) or len(shape) != 1 or not isinstance(shape[0], int):
        raise RecordingError(f"{where}: expected a shape of one number, found {shape}")
    names, units = feature.get("names"), feature.get("units")
    if not isinstance(names, list | dict | None) or not isinstance(units, list | None):
        raise RecordingError(
            f"{where}: expected names and units in lists, found names {names!r}, units {units!r}"
        )
    names = _flat_names(names)
    if names is None:
        names = [f"{name.rpartition('.')[2]}_{place}" for place in range(shape[0])]
    for key, found in (("names", names), ("units", units)):
        if found is not None and len(found) != shape[0]:
            raise RecordingError(f"{where}: {len(found)} {key} for {shape[0]} values: {found}")
    return Channels(tuple(names), ("",) * shape[0] if units is None else tuple(map(str, units)))


def _flat_names(names: list[Any] | dict[str, Any] | None) -> list[str] | None:
    """Channel names from a list, a list in a list, a dict of lists, or null."""
    if names is None:
        return None
    if isinstance(names, dict):
        named_lists = all(isinstance(value, list) for value in names.values())
        names = list(names.values()) if named_lists else list(names)
    lists = [name if isinstance(name, list) else [name] for name in names]
    return [str(name) for each in lists for name in each]


def _sidecar_channels(members: Mapping[str, NDArray[Any]], width: int, path: Path) -> Channels:
    if "names" in members:
        names, default = tuple(map(str, members["names"])), ("",) * width
    elif width == len(SENSOR.names):
        names, default = SENSOR.names, SENSOR.units
    else:
        stream = path.parent.name
        names, default = tuple(f"{stream}_{channel}" for channel in range(width)), ("",) * width
    units = tuple(map(str, members["units"])) if "units" in members else default
    if len(names) != width or len(units) != width:
        raise RecordingError(
            f"{path}: {width} values a reading, but {len(names)} names and {len(units)} units"
        )
    return Channels(names, units)
