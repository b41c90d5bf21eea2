"""A LeRobot data set's `meta/`: its documents as models, and the place of each episode's data.

v2.0 and v2.1 have one file per episode, v3.0 many episodes per file. This module reads only
`meta/`. The `group` of an episode and the `units` and `kind` of a feature are this project's
extensions.
"""

import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import pairwise, product
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AliasChoices, BeforeValidator, Field, JsonValue, Strict, model_validator

from pipeline.base.config import MediaLimits
from pipeline.base.documents import Border, Document, Text, shown
from pipeline.base.errors import RecordingError
from pipeline.base.provenance import is_view_name
from pipeline.data.lerobot_rows import ParquetTable
from pipeline.data.recording import ActionKind, Grouped, natural_key
from pipeline.data.video import VideoSpan, frame_count

META = Border(
    RecordingError, "Mend meta/, or convert the data set with the lerobot release that wrote it."
)
MARKER = "meta/info.json"
_INFO_BYTES = 8 * 2**20
_ENTRY_COLUMNS = ("episode_index", "length", "tasks", "group")
_TASK_COLUMNS = ("task_index", "task", "__index_level_0__")
_VIEW_PREFIXES = ("observation.images.", "observation.")
_PLACES = {"v2": "episode_chunk|episode_index", "v3": "chunk_index|file_index"}
"""Placeholders that a path may have, as in `{episode_index:06d}`."""

Index = Annotated[
    int,
    Field(ge=0, lt=10**9),
    BeforeValidator(lambda n: int(n) if isinstance(n, float) and n.is_integer() else n),
]
"""A whole float is accepted too, because pandas turns integer columns into floats."""
Seconds = Annotated[float, Field(ge=0, le=1e9)]


def _flat_names(names: Any) -> Any:
    """Channel names from a list, a nested list or a dict of lists; others are refused later."""
    if isinstance(names, dict):
        named_lists = all(isinstance(value, list) for value in names.values())
        names = list(names.values() if named_lists else names)
    if not isinstance(names, list):
        return names
    lists = [name if isinstance(name, list) else [name] for name in names]
    return tuple(name for part in lists for name in part)


def sidecar(root: Path, name: str, index: int = 0) -> Path:
    """The path of an episode's sidecar file `name`, whether it exists or not."""
    return root / name / f"episode_{index:06d}.npz"


class _VideoInfo(Document):
    depth: Annotated[bool | None, Strict(False)] = Field(
        default=None, validation_alias=AliasChoices("is_depth_map", "video.is_depth_map")
    )


class Feature(Document):
    """A column or a video, as `info.json` describes it."""

    dtype: Text
    shape: JsonValue = None
    names: JsonValue = None
    units: tuple[Text, ...] | None = None
    kind: ActionKind | None = None
    """The kind of the actions; None means that their names decide."""
    info: _VideoInfo | None = None
    video_info: _VideoInfo | None = None
    """The name of `info` in data sets migrated from v1."""

    @property
    def is_depth_map(self) -> bool:
        """Whether its images are depth maps, by any of the entries for it."""
        return any(info is not None and info.depth for info in (self.info, self.video_info))


class Vector(Document):
    """A column of numbers, as `info.json` describes it; checked only where the column is read."""

    shape: Annotated[tuple[Index], Strict(False)]
    names: Annotated[tuple[Text, ...] | None, BeforeValidator(_flat_names)] = None
    """Flat."""


class Info(Document):
    """`meta/info.json`."""

    codebase_version: Literal["v2.0", "v2.1", "v3.0"]
    fps: Annotated[float, Field(ge=1e-3, le=1e3)]
    """Matroska counts milliseconds, and could not tell frames of a higher rate apart."""
    features: Annotated[dict[Text, Feature], Field(max_length=1000)]
    chunks_size: Annotated[int, Field(ge=1, lt=10**9)]
    data_path: Text
    video_path: Text | None = None

    @property
    def shared(self) -> bool:
        """Whether a file holds many episodes, as in v3.0."""
        return self.codebase_version == "v3.0"

    @cached_property
    def videos(self) -> list[str]:
        """Feature keys of the videos."""
        return [key for key, feature in self.features.items() if feature.dtype == "video"]

    @cached_property
    def views(self) -> dict[str, str]:
        """Feature keys of the cameras, by view name; depth maps are not views."""
        keys: dict[str, str] = {}
        for key, feature in self.features.items():
            if feature.dtype in ("video", "image") and not feature.is_depth_map:
                view = key.removeprefix(next(filter(key.startswith, _VIEW_PREFIXES), ""))
                if not is_view_name(view):
                    raise ValueError(f"features: a camera cannot have the name {shown(key)}")
                if (other := keys.setdefault(view, key)) != key:
                    both = f"features {shown(other)} and {shown(key)} are both the view {view!r}"
                    raise ValueError(f"{both}; rename one of them there and in its files")
        return keys

    @model_validator(mode="after")
    def _check_names(self) -> Self:
        _ = self.views  # refuses their names
        if self.videos and self.video_path is None:
            raise ValueError("video_path: missing, but features has videos")
        numbers = _PLACES[self.codebase_version[:2]]
        for name, path in (("data_path", self.data_path), ("video_path", self.video_path or "")):
            rest = re.sub(rf"\{{({numbers})(:[0-9]{{0,2}}d?)?\}}", "0", path)
            if name == "video_path":
                rest = rest.replace("{video_key}", "key")
            if "{" in rest or "}" in rest or rest.startswith("/") or ".." in rest.split("/"):
                known = f"{numbers.replace('|', ', ')} and, of videos, video_key"
                raise ValueError(
                    f"{name}: expected a path inside the data set, with no placeholder but {known} "
                    f"(and no more than two digits), found {shown(path)}"
                )
        return self


class Place(Document):
    """A file of v3.0."""

    chunk_index: Index
    file_index: Index


class Span(Place):
    """An episode's frames in a video of v3.0, in seconds of the video."""

    from_timestamp: Seconds
    to_timestamp: Seconds


class Entry(Grouped):
    """An episode as a line of `meta/episodes.jsonl`, or a row of v3.0's `meta/episodes/`."""

    index: Index = Field(alias="episode_index")
    length: Index
    tasks: Annotated[tuple[Text, ...], Strict(False)] | None = None
    data: Place | None = None
    """Of v3.0, where episodes share files; likewise `videos`."""
    videos: dict[str, Span] = Field(default_factory=dict[str, Span])

    @property
    def id(self) -> str:
        """Such as `episode_000003`."""
        return f"episode_{self.index:06d}"


class Task(Document):
    """A line of `meta/tasks.jsonl` or a row of `meta/tasks.parquet`."""

    index: Index = Field(alias="task_index")
    # Up to lerobot 0.4.4 the column was an unnamed index of pandas.
    text: Text = Field(validation_alias=AliasChoices("task", "__index_level_0__"))


@dataclass(frozen=True)
class LeRobotMeta:
    """A data set: what its episodes share, and where each of them is."""

    root: Path
    info: Info
    entries: Sequence[Entry]
    """In the order of their indices."""
    task_text: Mapping[int, str]
    limits: MediaLimits
    """Limits of its files."""

    def data(self, entry: Entry) -> Path:
        """The file of an episode's rows, as `meta/` says."""
        return self.root / self.info.data_path.format(**self._numbers(entry, entry.data))

    def video(self, entry: Entry, key: str) -> VideoSpan:
        """An episode's frames of the video of a feature."""
        span, fps = entry.videos.get(key), self.info.fps
        numbers = self._numbers(entry, span)
        path = self.root / (self.info.video_path or "").format(video_key=key, **numbers)
        if span is None:
            return VideoSpan(path)
        # Rounded, because the timestamps are inexact sums such as 36.900000000000006.
        count = round((span.to_timestamp - span.from_timestamp) * fps)
        return VideoSpan(path, round(span.from_timestamp * fps), count)

    def _numbers(self, entry: Entry, place: Place | None) -> dict[str, int]:
        """The numbers in a path."""
        own = {"episode_index": entry.index, "episode_chunk": entry.index // self.info.chunks_size}
        return own | (place.model_dump() if place else {})

    def check_spans(self, keys: Collection[str]) -> None:
        """Raise `RecordingError` where `meta/` gives an episode frames of another in these videos.

        That is so where two episodes share a frame, and where a video is too short and no episode
        begins at its start. A video whose first episode begins at frame 0 may be truncated, and one
        that reaches its last episode's end may belong to a trimmed copy: both pass.
        """
        place = self.root / "meta" / "episodes"
        spans: dict[Path, list[tuple[int, int, str]]] = defaultdict(list)
        for entry, key in product(self.entries, keys):
            span = self.video(entry, key)
            first = span.first or 0
            spans[span.path].append((first, first + entry.length, entry.id))
        for path, of_file in spans.items():
            of_file.sort()
            for (_, stop, before), (first, _, after) in pairwise(of_file):
                if first < stop:
                    why = f"{before} and {after} have the same frames of {path}: file_index or "
                    raise META.refusal(place, f"{why}from_timestamp of one is wrong")
            first, stop = of_file[0][0], of_file[-1][1]
            if first and 0 < (frames := frame_count(path, self.limits)) < stop:
                why = f"expected from_timestamp and length for frames 0 to {frames - 1} of {path}, "
                raise META.refusal(place, f"{why}found {first} to {stop - 1}")


def read_meta(root: Path, limits: MediaLimits) -> LeRobotMeta:
    """The data set that its `meta/` describes.

    Raises `RecordingError`, which names the wrong file of `meta/` and the place in it, also where
    two cameras would be one view or an episode is listed twice.
    """
    info = META.read_json(root / MARKER, Info, _INFO_BYTES)
    path = root / "meta" / ("episodes" if info.shared else "episodes.jsonl")
    rows = _shared_entries(path, info, limits) if info.shared else META.read_json_lines(path, Entry)
    entries = sorted(rows, key=lambda entry: entry.index)
    for before, entry in pairwise(entries):
        if before.index == entry.index:
            raise META.refusal(path, f"expected each episode once, found {entry.id} twice")
    return LeRobotMeta(root, info, entries, _task_text(root, info.shared, limits), limits)


def _shared_entries(folder: Path, info: Info, limits: MediaLimits) -> Iterator[Entry]:
    files = sorted(folder.glob("chunk-*/file-*.parquet"), key=natural_key)
    if not files:
        raise META.refusal(folder, "expected chunk-000/file-000.parquet, found none")
    columns = [*_ENTRY_COLUMNS, *(f"data/{name}" for name in Place.model_fields)]
    columns += [f"videos/{key}/{name}" for key in info.videos for name in Span.model_fields]
    for path in files:
        for where, cells in ParquetTable(path, limits).rows(columns):
            row: dict[str, Any] = {"data": {}, "videos": {key: {} for key in info.videos}}
            for column, cell in cells.items():
                *parents, name = column.split("/")  # no key contains a slash
                reduce(lambda inner, parent: inner.setdefault(parent, {}), parents, row)[name] = (
                    cell
                )
            yield META.parse(row, Entry, where)


def _task_text(root: Path, shared: bool, limits: MediaLimits) -> dict[int, str]:
    """The tasks' texts by index; empty where there is no such file."""
    path = root / "meta" / ("tasks.parquet" if shared else "tasks.jsonl")
    if not path.exists():
        return {}
    if shared:
        rows = ParquetTable(path, limits).rows(_TASK_COLUMNS)
        tasks = (META.parse(cells, Task, where) for where, cells in rows)
    else:
        tasks = META.read_json_lines(path, Task)
    texts: dict[int, str] = {}
    for task in tasks:
        if texts.setdefault(task.index, task.text) != task.text:
            raise META.refusal(path, f"expected each task once, found {task.index} twice")
    return texts
