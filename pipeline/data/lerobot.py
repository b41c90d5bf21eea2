"""LeRobot data sets v2.0, v2.1 and v3.0: state and action from parquet, frames from video.

Rows and frames pair by number; the `timestamp` column is the clock, which `lerobot_rows` reads.
This project's sidecar files, beside the data set's own folders, hold data for which LeRobot has no
place: `sensor/episode_000003.npz` has a high-rate sensor, `state/…` states faster than the rows,
`frames/…` the capture times of the images in the rows.
"""

import json
import os
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.base.config import MediaLimits, Source
from pipeline.base.documents import Text, shown, uncollected
from pipeline.base.errors import RecordingError
from pipeline.data.arrays import matrix, member, read_npz
from pipeline.data.insertion import SENSOR
from pipeline.data.lerobot_meta import (
    MARKER,
    META,
    Entry,
    LeRobotMeta,
    Vector,
    read_meta,
    sidecar,
)
from pipeline.data.lerobot_rows import (
    CLOCK,
    EPISODE,
    FRAME,
    ParquetCamera,
    ParquetRows,
    ParquetTable,
    check_frames,
    read_clock,
    stored_clock,
)
from pipeline.data.recording import (
    RECORDINGS,
    ActionKind,
    CameraStream,
    Channels,
    RecordedAction,
    Recording,
    Stream,
    checked_stream,
    natural_key,
)
from pipeline.data.video import VideoClip, VideoSpan

STATE = "observation.state"
ACTION = "action"
_MOST_CHANNELS = 65_536
_SIDECARS = ("sensor", "state", "frames")
_DELTA = re.compile(r"delta.*|d(x|y|z|a|b|r|rx|ry|rz|alpha|beta|gamma|roll|pitch|yaw)")


def is_root(folder: Path, names: Collection[str]) -> bool:
    """Whether a folder with these entries is a LeRobot data set."""
    return "meta" in names and (folder / MARKER).is_file()


@uncollected()
def open_data_set(
    root: Path, source: Source, views: Sequence[str] | None
) -> tuple[list["LeRobotRecording"], list[str]]:
    """The episodes whose files exist, and one line for each listed episode whose files do not.

    Raises `RecordingError` where `meta/` is broken.
    """
    meta = read_meta(root, source.limits)
    wanted = [key for view, key in meta.info.views.items() if views is None or view in views]
    meta.check_spans([key for key in wanted if key in meta.info.videos])
    recordings: list[LeRobotRecording] = []
    missing: list[str] = []
    refusal = cache(_refusal)  # many episodes may be in one file
    for entry in meta.entries:
        recording = LeRobotRecording(meta, entry, source, views)
        if why := next(filter(None, map(refusal, recording.listed_files())), ""):
            missing.append(f"{source.name}: {root} lists {entry.id}, but {why}")
        else:
            recordings.append(recording)
    return recordings, missing


def _refusal(path: Path) -> str:
    """Why a file cannot hold an episode; '' where it can."""
    try:
        RECORDINGS.check_file(path)
    except RecordingError as error:
        return str(error)
    return ""


class LeRobotRecording(Recording):
    """One episode of a LeRobot data set; `path` is the data set's root."""

    format = "lerobot"

    def __init__(
        self,
        meta: LeRobotMeta,
        entry: Entry,
        source: Source,
        views: Sequence[str] | None,
    ) -> None:
        super().__init__(meta.root, source, views)
        self.id = entry.id
        self._meta = meta
        self._info = meta.info
        self._entry = entry

    @property
    def group(self) -> str | None:
        return self._entry.group_name

    @property
    def _rows(self) -> ParquetRows:
        return _find_rows(self._meta, self._entry)

    def listed_files(self) -> Iterator[Path]:
        """The data file and the wanted views' videos, as `meta/` names them."""
        yield self._meta.data(self._entry)
        for key in self._wanted().values():
            if key in self._info.videos:
                yield self._video(key).path

    def _wanted(self) -> dict[str, str]:
        """Feature keys of the wanted views."""
        return {view: key for view, key in self._info.views.items() if self._wants(view)}

    def _video(self, key: str) -> VideoSpan:
        return self._meta.video(self._entry, key)

    def files(self) -> list[Path]:
        _, *videos = self.listed_files()
        sidecars = [path for name in _SIDECARS if (path := self._sidecar(name)) is not None]
        return sorted({self._rows.path, *videos, *sidecars})

    def identity(self) -> str:
        """The parts of `meta/` that decide what is read from the episode's files.

        It is not all of `meta/`, which changes whenever an episode is added.
        """
        read = {STATE, ACTION, *self._wanted().values()}
        deciding = {
            "fps": self._info.fps,
            "features": {
                name: {"dtype": feature.dtype, "names": feature.names, "units": feature.units}
                for name, feature in self._info.features.items()
                if name in read
            },
        }
        described = json.dumps(deciding, sort_keys=True, separators=(",", ":"))
        if (action := self._info.features.get(ACTION)) is not None and action.kind is not None:
            described += f" kind={action.kind}"
        where, table, time = self._numbers(())
        if not np.array_equal(time, stored_clock(table, where)):
            # Stores of versions before exact clocks hold other times.
            described += " clock=frame_index/fps"
        if not self._info.shared:
            return described
        videos = {v: key for v, key in self._info.views.items() if key in self._info.videos}
        frames = [f"{view}@{self._video(key).first}" for view, key in sorted(videos.items())]
        return " ".join([described, f"{self._entry.id}+{self._entry.length}", *frames])

    def state(self) -> Stream | None:
        if (path := self._sidecar("state")) is not None:
            return _read_sidecar(path, self._overrides.limits)
        return self._stream(STATE) if STATE in self._info.features else None

    def action(self) -> RecordedAction:
        if (feature := self._info.features.get(ACTION)) is None:
            why = f"no feature {ACTION!r} (as a robot's run that stopped before its first action); "
            why += f"it has {shown([*self._info.features])}"
            raise META.refusal(self.path / MARKER, why)
        stream, kind = self._stream(ACTION), self._overrides.action_kind
        if kind == "auto":
            kind = feature.kind or action_kind(stream.channels.names)
        return RecordedAction(stream.channels, stream.time, stream.values, kind, self._info.fps)

    def sensor(self) -> Stream | None:
        path = self._sidecar("sensor")
        return None if path is None else _read_sidecar(path, self._overrides.limits)

    def all_views(self) -> Sequence[str]:
        return sorted(self._info.views)

    def _recorded_instruction(self) -> str:
        if self._entry.tasks and len(self._entry.tasks) == 1:
            return self._entry.tasks[0]
        rows = self._rows
        where, table = f"{rows.path}, {self._entry.id}", rows.columns(("task_index",))
        if not table.num_columns:
            raise META.refusal(where, "no column task_index, and meta/ names no one task")
        tasks = np.unique(matrix(table["task_index"], 1, f"{where}, 'task_index'")).tolist()
        texts = [self._meta.task_text.get(index) for index in tasks]
        if len(texts) != 1 or texts[0] is None:
            raise RecordingError(
                f"{where}: expected one task that meta/ knows, found task_index {shown(tasks)}: "
                f"{shown(texts)}; give source {self.source!r} an `instruction`"
            )
        return texts[0]

    def _cameras(self) -> Mapping[str, CameraStream]:
        if not (wanted := self._wanted()):
            return {}
        _, _, time = self._numbers()
        rows = self._rows
        videos, fps, limits = self._info.videos, self._info.fps, self._overrides.limits
        path, images = self._sidecar("frames"), [v for v, k in wanted.items() if k not in videos]
        captured = read_npz(path, images, limits=limits) if path and images else {}
        return {
            view: VideoClip(view, time, self._video(key), fps, limits)
            if key in videos
            else ParquetCamera(view, time, rows, key, captured.get(view))
            for view, key in sorted(wanted.items())
        }

    def _stream(self, name: str) -> Stream:
        feature, where = self._info.features[name], f"{self.path / MARKER}, {name!r}"
        vector = META.parse(feature.model_dump(), Vector, where)
        stem, (width,) = name.rpartition(".")[2], vector.shape
        channels = _channels(stem, width, vector.names, feature.units, where)
        where, table, time = self._numbers()
        if name not in table.column_names:
            raise RECORDINGS.refusal(where, f"missing column {name!r}")
        where += f", {name!r}"
        values = matrix(table[name], width, where)
        return checked_stream(channels, time, values.astype(np.float32), where)

    def _numbers(
        self, streams: Sequence[str] = (STATE, ACTION)
    ) -> tuple[str, pa.Table, NDArray[np.float64]]:
        """The place of the episode's rows (for messages), these columns, and the clock."""
        rows = self._rows
        table = rows.columns((CLOCK, FRAME, *streams))
        check_frames(table, rows)
        where = f"{rows.path}, {self._entry.id}"
        return where, table, read_clock(table, self._info.fps, where)

    def _sidecar(self, name: str) -> Path | None:
        """The episode's sidecar file of that name; None where there is none."""
        path = sidecar(self.path, name, self._entry.index)
        return path if os.path.lexists(path) else None


def _find_rows(meta: LeRobotMeta, entry: Entry) -> ParquetRows:
    """The episode's rows, found by `episode_index`; the whole file if it has no such column.

    The metadata's file_index can be stale (lerobot up to 0.4.4), so if the named file has none of
    the rows, the other data files of v3.0 are searched. Raises `RecordingError` where the rows are
    not as many as `meta/` says (with both counts), or not together.
    """
    shared, named = meta.info.shared, meta.data(entry)
    others = sorted((meta.root / "data").glob("*/*.parquet"), key=natural_key) if shared else []
    for path in [named, *(other for other in others if other != named and other.is_file())]:
        table = ParquetTable(path, meta.limits)
        columns = table.numbers((EPISODE, CLOCK))
        if EPISODE in columns.column_names:
            index = matrix(columns[EPISODE], 1, f"{path}, {EPISODE!r}")[:, 0]
        elif shared:
            raise RECORDINGS.refusal(path, f"missing column {EPISODE!r}")
        else:
            index = np.full(columns.num_rows, float(entry.index))
        rows = np.flatnonzero(index == entry.index)
        if rows.size:
            of = f"rows of episode {entry.index}"
            if rows.size != entry.length:
                raise META.refusal(path, f"{rows.size} {of}, but meta/ says {entry.length}")
            if rows[-1] - rows[0] + 1 != rows.size:
                raise META.refusal(path, f"{of} are not together")
            return ParquetRows(table, int(rows[0]), int(rows[-1]) + 1)
    raise RecordingError(
        f"{named}: has no row of episode {entry.index}{', nor has any other file' * shared}. "
        "Give the data files their own names again, or copy the data set again"
    )


def action_kind(names: Sequence[str]) -> ActionKind:
    """The kind of action by the names of its channels; absolute where they do not say."""
    lower = [name.lower() for name in names]
    if any("vel" in name for name in lower):
        return "velocity"
    return "delta" if any(_DELTA.fullmatch(name) for name in lower) else "absolute"


def _read_sidecar(path: Path, limits: MediaLimits) -> Stream:
    """The stream of a file with `timestamps`, `values` and optional `names` and `units`."""
    members = read_npz(path, ("timestamps", "values"), text=("names", "units"), limits=limits)
    values = member(members, ("values",), path)
    if values.ndim != 2:
        raise RecordingError(f"{path}: expected values (N, channel), found {values.shape}")
    names, units = (
        RECORDINGS.parse(
            np.atleast_1d(members.get(key, ())).tolist(), tuple[Text, ...], f"{path}, {key!r}"
        )
        for key in ("names", "units")
    )
    width = values.shape[1]
    if not names and width == len(SENSOR.names):
        names, units = SENSOR.names, units or SENSOR.units
    channels = _channels(path.parent.name, width, names, units, str(path))
    return checked_stream(channels, member(members, ("timestamps",), path), values, str(path))


def _channels(
    stem: str, width: int, names: tuple[str, ...] | None, units: tuple[str, ...] | None, where: str
) -> Channels:
    """Channels with these names and units; without names, the stem and a number."""
    if width > _MOST_CHANNELS:
        raise META.refusal(where, f"expected at most {_MOST_CHANNELS:,} channels, found {width:,}")
    names = names or tuple(f"{stem}_{channel}" for channel in range(width))
    units = units or ("",) * width
    if len(names) != width or len(units) != width:
        why = f"{width} values a reading, but {len(names)} names and {len(units)} units"
        raise META.refusal(where, why)
    if twins := [name for name, count in Counter(names).items() if count > 1]:
        why = f"expected each channel name once, found {shown(twins)} more often"
        raise META.refusal(where, why)
    return Channels(names, units)
