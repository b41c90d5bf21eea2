"""What a LeRobot data set's `meta/` says: where each episode's rows and frames are.

v2.0 and v2.1 keep a file an episode, v3.0 many episodes a file. Only `meta/` is read here.
"""

import json
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.errors import RecordingError
from pipeline.data.arrays import group_name, number, read_json
from pipeline.data.reader import natural_key
from pipeline.data.video import VideoSpan

VERSIONS = ("v2.0", "v2.1", "v3.0")
_VIEW_PREFIXES = ("observation.images.", "observation.")
_V3_TEXT = ("task", "__index_level_0__")
"""Column of a task's text from lerobot 0.5.0 on, and before."""


@dataclass(frozen=True)
class LeRobotEntry:
    """One episode as `meta/` lists it."""

    index: int
    length: int
    tasks: tuple[str, ...]
    data: Path
    shared: bool
    """Whether other episodes' rows may stand in the same file."""
    videos: Mapping[str, VideoSpan]
    """By feature key."""
    group: str | None
    """Of the episodes that belong together, this project's extension."""

    @property
    def id(self) -> str:
        """As in `episode_000003`."""
        return f"episode_{self.index:06d}"


@dataclass(frozen=True)
class LeRobotLayout:
    """What all episodes of a data set share."""

    root: Path
    version: str
    fps: float
    features: Mapping[str, Mapping[str, Any]]
    task_text: Mapping[int, str]

    @property
    def views(self) -> Mapping[str, str]:
        """Feature keys of the cameras, by view name."""
        return {_view_name(key): key for key in _cameras(self.features, depth=False)}

    @property
    def depth(self) -> Mapping[str, str]:
        """Feature keys of the depth maps, which are no views, by view name."""
        return {_view_name(key): key for key in _cameras(self.features, depth=True)}


def read_layout(root: Path) -> tuple[LeRobotLayout, tuple[LeRobotEntry, ...]]:
    """The data set's layout, and its episodes by index.

    Raises `RecordingError` naming the file of `meta/` that is wrong, and the place in it: also
    where two cameras would be one view, or an episode is listed twice.
    """
    path = root / "meta" / "info.json"
    info = read_json(path)
    version = info.get("codebase_version")
    if version not in VERSIONS:
        raise RecordingError(
            f"{path}: codebase_version is {version!r}; this reader knows {', '.join(VERSIONS)}. "
            "Convert the data set with the lerobot release that it names"
        )
    fps = number(info, "fps", str(path), positive=True)
    features = info.get("features")
    if fps is None or not isinstance(features, dict):
        raise RecordingError(f"{path}: expected fps and features, found {', '.join(info)}")
    try:
        read = _entries_v3(root, info, fps) if version == "v3.0" else _entries_v2(root, info)
        entries = _apart(sorted(read, key=lambda entry: entry.index), root)
        _check_view_names(features, path)
        tasks = _tasks_v3(root) if version == "v3.0" else _tasks_v2(root)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        if isinstance(error, RecordingError):
            raise
        raise RecordingError(f"{root / 'meta'}: cannot be understood: {error!r}") from None
    return LeRobotLayout(root, version, fps, features, tasks), entries


def _apart(entries: Sequence[LeRobotEntry], root: Path) -> tuple[LeRobotEntry, ...]:
    """Entries in the order of their index with their rivals for frames, none of them twice."""
    for one, other in pairwise(entries):
        if one.index == other.index:
            place = root / "meta" / ("episodes" if one.shared else "episodes.jsonl")
            raise RecordingError(
                f"{place}: expected each episode once, found {one.id} twice. Remove one of the "
                "two entries, or write the data set again"
            )
    rivals = _rivals(entries)
    return tuple(
        replace(
            entry,
            videos={
                key: replace(span, rival=rivals.get((entry.index, key), ""))
                for key, span in entry.videos.items()
            },
        )
        for entry in entries
    )


def _rivals(entries: Sequence[LeRobotEntry]) -> dict[tuple[int, str], str]:
    """Of each span that overlaps another episode's, by index and feature key: that episode."""
    by_file: dict[Path, list[tuple[int, int, str, LeRobotEntry]]] = defaultdict(list)
    for entry in entries:
        for key, span in entry.videos.items():
            if span.first is not None:
                by_file[span.path].append((span.first, entry.index, key, entry))
    rivals: dict[tuple[int, str], str] = {}
    for spans in by_file.values():
        until, last = 0, None
        for first, index, key, entry in sorted(spans, key=lambda span: span[:2]):
            if last is not None and first < until:
                rivals[index, key], rivals[last.index, key] = last.id, entry.id
            if last is None or first + entry.length > until:
                until, last = first + entry.length, entry
    return rivals


def _cameras(features: Mapping[str, Mapping[str, Any]], depth: bool) -> list[str]:
    """Feature keys of cameras that are depth maps, or of the others."""
    return [
        key
        for key, feature in features.items()
        if feature.get("dtype") in ("video", "image") and _is_depth(feature) == depth
    ]


def _is_depth(feature: Mapping[str, Any]) -> bool:
    """`video_info` is what sets migrated from v1 call `info`."""
    told = [info for name in ("info", "video_info") if isinstance(info := feature.get(name), dict)]
    return any(info.get(name) for info in told for name in ("is_depth_map", "video.is_depth_map"))


def _check_view_names(features: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    keys: dict[str, str] = {}
    for key in _cameras(features, depth=False):
        if (other := keys.setdefault(_view_name(key), key)) != key:
            raise RecordingError(
                f"{path}: features {other!r} and {key!r} are both the view {_view_name(key)!r}, "
                "and only one can be. Rename one of them there and in the data set's files"
            )


def _view_name(key: str) -> str:
    for prefix in _VIEW_PREFIXES:
        if key.startswith(prefix):
            return key.removeprefix(prefix)
    return key


def _video_keys(info: Mapping[str, Any]) -> list[str]:
    return [key for key, f in info["features"].items() if f.get("dtype") == "video"]


def _entries_v2(root: Path, info: Mapping[str, Any]) -> Iterator[LeRobotEntry]:
    path = root / "meta" / "episodes.jsonl"
    chunk = number(info, "chunks_size", str(root / "meta" / "info.json"), positive=True)
    if chunk is None or chunk % 1:
        raise RecordingError(
            f"{root / 'meta' / 'info.json'}: chunks_size must be a whole number, found {chunk}"
        )
    for row in _jsonl(path, ("episode_index", "length")):
        index = int(row["episode_index"])
        place = {"episode_index": index, "episode_chunk": index // int(chunk)}
        yield LeRobotEntry(
            index=index,
            length=int(row["length"]),
            tasks=_texts(row, path),
            data=root / info["data_path"].format(**place),
            shared=False,
            videos={
                key: VideoSpan(root / info["video_path"].format(video_key=key, **place))
                for key in _video_keys(info)
            },
            group=group_name(row, str(path)),
        )


def _entries_v3(root: Path, info: Mapping[str, Any], fps: float) -> Iterator[LeRobotEntry]:
    folder = root / "meta" / "episodes"
    files = sorted(folder.glob("chunk-*/file-*.parquet"), key=natural_key)
    if not files:
        raise RecordingError(f"{folder}: expected chunk-000/file-000.parquet, found none")
    keys = _video_keys(info)
    needed = ["episode_index", "length", "data/chunk_index", "data/file_index"]
    for key in keys:
        needed += [f"videos/{key}/{field}" for field in _SPAN_FIELDS]
    for row in _rows(files, needed):
        yield LeRobotEntry(
            index=row["episode_index"],
            length=row["length"],
            tasks=_texts(row, folder),
            data=root
            / info["data_path"].format(
                chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
            ),
            shared=True,
            videos={key: _span_v3(root, info, row, key, fps) for key in keys},
            group=group_name(row, str(folder)),
        )


def _texts(row: Mapping[str, Any], where: Path) -> tuple[str, ...]:
    tasks = row.get("tasks") or []
    if not isinstance(tasks, list) or not all(isinstance(task, str) for task in tasks):
        raise RecordingError(
            f"{where}, episode {row['episode_index']}: expected tasks as texts, found {tasks!r}"
        )
    return tuple(tasks)


_SPAN_FIELDS = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")


def _span_v3(
    root: Path, info: Mapping[str, Any], row: Mapping[str, Any], key: str, fps: float
) -> VideoSpan:
    chunk, file, begin, end = (row[f"videos/{key}/{field}"] for field in _SPAN_FIELDS)
    path = info["video_path"].format(video_key=key, chunk_index=chunk, file_index=file)
    # Rounded to frame numbers: the timestamps are inexact sums such as 36.900000000000006.
    return VideoSpan(root / path, round(begin * fps), round((end - begin) * fps))


def _tasks_v2(root: Path) -> dict[int, str]:
    path = root / "meta" / "tasks.jsonl"
    if not path.is_file():
        return {}
    rows = _jsonl(path, ("task_index", "task"))
    return {int(row["task_index"]): str(row["task"]) for row in rows}


def _tasks_v3(root: Path) -> dict[int, str]:
    path = root / "meta" / "tasks.parquet"
    if not path.is_file():
        return {}
    rows = list(_rows([path], ["task_index"]))
    text = next((name for name in _V3_TEXT if rows and name in rows[0]), None)
    return {row["task_index"]: row[text] for row in rows} if text else {}


def _rows(files: Sequence[Path], needed: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Rows of parquet files of `meta/`, statistics left out."""
    for path in files:
        try:
            with pq.ParquetFile(path) as file:
                columns = [n for n in file.schema_arrow.names if not n.startswith("stats/")]
                missing = [name for name in needed if name not in columns]
                if missing:
                    raise RecordingError(
                        f"{path}: missing column(s) {', '.join(missing)}; "
                        f"it has {', '.join(columns)}"
                    )
                rows = file.read(columns=columns).to_pylist()
        except (pa.ArrowException, OSError) as error:
            raise RecordingError(f"{path}: cannot be read as parquet: {error}") from None
        for place, row in enumerate(rows):
            empty = [name for name in needed if row[name] is None]
            if empty:
                raise RecordingError(f"{path}, row {place}: {', '.join(empty)} is null")
            for name in needed:
                if isinstance(row[name], float) and not math.isfinite(row[name]):
                    raise RecordingError(f"{path}, row {place}: {name} is {row[name]}")
            yield row


def _jsonl(path: Path, needed: Sequence[str]) -> Iterator[dict[str, Any]]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from None
    for place, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except ValueError as error:
            raise RecordingError(f"{path}, line {place}: not JSON: {error}") from None
        if not isinstance(row, dict) or any(key not in row for key in needed):
            raise RecordingError(
                f"{path}, line {place}: expected an object with {', '.join(needed)}"
            )
        yield row
