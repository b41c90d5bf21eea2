"""The documents in a LeRobot data set's `meta/`, as models: what they may say.

`group` of an episode, and `units` and `kind` of a feature are this project's extensions.
"""

import re
from functools import cached_property
from typing import Annotated, Any, Literal, Self

from pydantic import AliasChoices, BeforeValidator, Field, JsonValue, Strict, model_validator

from pipeline.base.border import Border, Document, Text, shown
from pipeline.base.errors import RecordingError
from pipeline.base.source import is_view_name
from pipeline.data.media import Grouped
from pipeline.data.recording import ActionKind

META = Border(
    RecordingError, "Mend meta/, or convert the data set with the lerobot release that wrote it."
)
_VIEW_PREFIXES = ("observation.images.", "observation.")
_PLACES = {"v2": "episode_chunk|episode_index", "v3": "chunk_index|file_index"}
"""Numbers that a path may name, as in `{episode_index:06d}`."""

Index = Annotated[
    int,
    Field(ge=0, lt=10**9),
    BeforeValidator(lambda n: int(n) if isinstance(n, float) and n.is_integer() else n),
]
"""A float without a fraction is taken too: pandas makes them of whole columns."""
Seconds = Annotated[float, Field(ge=0, le=1e9)]


def _flat_names(names: Any) -> Any:
    """Channel names from a list, a list in a list or a dict of lists; the rest is refused later."""
    if isinstance(names, dict):
        named_lists = all(isinstance(value, list) for value in names.values())
        names = list(names.values() if named_lists else names)
    if not isinstance(names, list):
        return names
    lists = [name if isinstance(name, list) else [name] for name in names]
    return tuple(name for each in lists for name in each)


class _VideoInfo(Document):
    depth: Annotated[bool | None, Strict(False)] = Field(default=None, alias="is_depth_map")
    video_depth: Annotated[bool | None, Strict(False)] = Field(
        default=None, alias="video.is_depth_map"
    )


class Feature(Document):
    """What `info.json` says of a column, or of a video."""

    dtype: Text
    shape: JsonValue = None
    names: JsonValue = None
    units: tuple[Text, ...] | None = None
    kind: ActionKind | None = None
    """Of the actions; None where their names tell it."""
    info: _VideoInfo | None = None
    video_info: _VideoInfo | None = None
    """What sets migrated from v1 call `info`."""

    @property
    def is_depth_map(self) -> bool:
        """Whether its pictures are of depth, by any of the words for it."""
        told = [info for info in (self.info, self.video_info) if info is not None]
        return any(info.depth or info.video_depth for info in told)


class Vector(Document):
    """What `info.json` says of the numbers of a column: judged only where it is read."""

    shape: Annotated[tuple[Index], Strict(False)]
    names: Annotated[tuple[Text, ...] | None, BeforeValidator(_flat_names)] = None
    """Flat."""


class Info(Document):
    """`meta/info.json`."""

    codebase_version: Literal["v2.0", "v2.1", "v3.0"]
    fps: Annotated[float, Field(ge=1e-3, le=1e5)]
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
        """Feature keys of the cameras, by view name."""
        return self._cameras(depth=False)

    @cached_property
    def depth(self) -> dict[str, str]:
        """Feature keys of the depth maps, which are no views, by view name."""
        return self._cameras(depth=True)

    def _cameras(self, depth: bool) -> dict[str, str]:
        keys: dict[str, str] = {}
        for key, feature in self.features.items():
            if feature.dtype in ("video", "image") and feature.is_depth_map == depth:
                view = key.removeprefix(next(filter(key.startswith, _VIEW_PREFIXES), ""))
                if not is_view_name(view):
                    raise ValueError(f"features: a camera cannot have the name {shown(key)}")
                if (other := keys.setdefault(view, key)) != key:
                    both = f"features {shown(other)} and {shown(key)} are both the view {view!r}"
                    raise ValueError(f"{both}; rename one of them there and in its files")
        return keys

    @model_validator(mode="after")
    def _check_names(self) -> Self:
        _ = self.views, self.depth
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
    """Frames of a video of v3.0, by the seconds in it."""

    from_timestamp: Seconds
    to_timestamp: Seconds


class Episode(Grouped):
    """A line of `meta/episodes.jsonl`, a row of `meta/episodes/`."""

    index: Index = Field(alias="episode_index")
    length: Index
    tasks: Annotated[tuple[Text, ...], Strict(False)] | None = None

    @property
    def id(self) -> str:
        """As in `episode_000003`."""
        return f"episode_{self.index:06d}"

    def place(self, chunks_size: int, key: str | None = None) -> dict[str, int]:
        """The numbers in the path of its rows, or of its frames of a feature."""
        return {"episode_index": self.index, "episode_chunk": self.index // chunks_size}

    def frames(self, key: str, fps: float) -> tuple[int | None, int | None]:
        """The first of its frames in the video of a feature and how many they are; None: all."""
        return None, None


class SharedEpisode(Episode):
    """An episode of v3.0, in files that it shares with others."""

    data: Place
    videos: dict[str, Span]

    def place(self, chunks_size: int, key: str | None = None) -> dict[str, int]:
        place = self.data if key is None else self.videos[key]
        return {"chunk_index": place.chunk_index, "file_index": place.file_index}

    def frames(self, key: str, fps: float) -> tuple[int | None, int | None]:
        # Rounded to frame numbers: the timestamps are inexact sums such as 36.900000000000006.
        begin, end = self.videos[key].from_timestamp, self.videos[key].to_timestamp
        return round(begin * fps), round((end - begin) * fps)


class Task(Document):
    """A line of `meta/tasks.jsonl`, a row of `meta/tasks.parquet`."""

    index: Index = Field(alias="task_index")
    # Up to lerobot 0.4.4 the column was an unnamed index of pandas.
    text: Text = Field(validation_alias=AliasChoices("task", "__index_level_0__"))
