"""What a LeRobot data set's `meta/` says: where each episode's rows and frames are.

v2.0 and v2.1 keep a file an episode, v3.0 many episodes a file. Only `meta/` is read here.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, TypeVar

from pipeline.base.config import MediaLimits
from pipeline.base.errors import RecordingError
from pipeline.data.lerobot_meta import META, Episode, Info, Place, SharedEpisode, Span, Task
from pipeline.data.parquet import ParquetTable
from pipeline.data.reader import natural_key
from pipeline.data.video import VideoSpan, frame_count

T = TypeVar("T")

MARKER = "meta/info.json"
_INFO_BYTES = 8 * 2**20
_MOST_ROWS = 500_000
"""Episodes or tasks of a data set; language_table has 440,000 episodes."""
_EPISODE_COLUMNS = ("episode_index", "length", "tasks", "group")
_OFF_FRAME = 0.1
"""Of a frame, by which the sum of inexact durations may miss it."""
_TASK_COLUMNS = ("task_index", "task", "__index_level_0__")


@dataclass(frozen=True)
class LeRobotLayout:
    """A data set: what all its episodes share, and where each of them is."""

    root: Path
    info: Info
    episodes: Sequence[Episode]
    """By index."""
    task_text: Mapping[int, str]
    limits: MediaLimits
    """Of its files."""

    def data(self, episode: Episode) -> Path:
        """The file of its rows, as `meta/` says."""
        return self.root / self.info.data_path.format(**episode.place(self.info.chunks_size))

    def video(self, episode: Episode, key: str) -> VideoSpan:
        """Its frames of the video of a feature."""
        place = episode.place(self.info.chunks_size, key)
        path = (self.info.video_path or "").format(video_key=key, **place)
        return VideoSpan(self.root / path, *episode.frames(key, self.info.fps))

    def check_ends(self) -> None:
        """Raise `RecordingError` where a video ends before its episodes, the first of which begins
        after it does: the frames of all would be others.

        With the first alone it may be of a trimmed copy, with the last alone it may be cut off.
        """
        for path, spans in self._spans.items():
            first, stop = spans[0][0], spans[-1][0] + spans[-1][3].length
            if first and 0 < (frames := frame_count(path, self.limits)) < stop:
                why = f"expected from_timestamp and length for frames 0 to {frames - 1} of {path}, "
                why += f"found {first} to {stop - 1}"
                raise META.refusal(self.root / "meta" / "episodes", why)

    @cached_property
    def _spans(self) -> Mapping[Path, list[tuple[int, int, str, Episode]]]:
        """By video: the first frame, index and feature key of its episodes and these, in order."""
        spans: dict[Path, list[tuple[int, int, str, Episode]]] = defaultdict(list)
        for episode in self.episodes:
            for key in self.info.videos:
                span = self.video(episode, key)
                spans[span.path].append((span.first or 0, episode.index, key, episode))
        return {path: sorted(of_file, key=lambda span: span[:3]) for path, of_file in spans.items()}

    @cached_property
    def rivals(self) -> Mapping[tuple[int, str], str]:
        """By an episode's index and a feature key: another that some of its frames go to too."""
        rivals: dict[tuple[int, str], str] = {}
        for spans in self._spans.values():
            until, last = 0, ("", spans[0][-1])
            for first, index, key, episode in spans:
                if first < until:
                    rivals[index, key], rivals[last[1].index, last[0]] = last[1].id, episode.id
                if first + episode.length > until:
                    until, last = first + episode.length, (key, episode)
        return rivals


def read_layout(root: Path, limits: MediaLimits) -> LeRobotLayout:
    """The data set as its `meta/` describes it.

    Raises `RecordingError` naming the file of `meta/` that is wrong, and the place in it: also
    where two cameras would be one view, or an episode is listed twice.
    """
    info = META.read_json(root / MARKER, Info, _INFO_BYTES)
    if info.shared:
        rows = _shared_episodes(root, info, limits)
    else:
        rows = META.read_json_lines(root / "meta" / "episodes.jsonl", Episode)
    episodes = sorted(_some(rows, root), key=lambda episode: episode.index)
    for one, other in pairwise(episodes):
        if one.index == other.index:
            place = root / "meta" / ("episodes" if info.shared else "episodes.jsonl")
            raise META.refusal(place, f"expected each episode once, found {one.id} twice")
    return LeRobotLayout(root, info, episodes, _task_text(root, info.shared, limits), limits)


def _shared_episodes(root: Path, info: Info, limits: MediaLimits) -> Iterator[Episode]:
    folder = root / "meta" / "episodes"
    files = sorted(folder.glob("chunk-*/file-*.parquet"), key=natural_key)
    if not files:
        raise META.refusal(folder, "expected chunk-000/file-000.parquet, found none")
    columns = [*_EPISODE_COLUMNS, *(f"data/{name}" for name in Place.model_fields)]
    columns += [f"videos/{key}/{name}" for key in info.videos for name in Span.model_fields]
    for path in files:
        for where, cells in ParquetTable(path, limits).rows(columns):
            row: dict[str, Any] = {"videos": {key: {} for key in info.videos}}
            for column, cell in cells.items():
                *parents, name = column.split("/")  # no key has one
                reduce(lambda inner, parent: inner.setdefault(parent, {}), parents, row)[name] = (
                    cell
                )
            episode = META.parse(row, SharedEpisode, where)
            for key, span in episode.videos.items():
                frame = span.from_timestamp * info.fps
                if abs(frame - round(frame)) > _OFF_FRAME:
                    why = f"videos/{key}/from_timestamp: expected the time of a frame at fps "
                    why += f"{info.fps:g}, found {span.from_timestamp:.6g} s, frame {frame:.2f}"
                    raise META.refusal(where, why)
            yield episode


def _task_text(root: Path, shared: bool, limits: MediaLimits) -> dict[int, str]:
    """The tasks' texts by their index; none where there is no file of them."""
    path = root / "meta" / ("tasks.parquet" if shared else "tasks.jsonl")
    if not path.exists():
        return {}
    if shared:
        rows = ParquetTable(path, limits).rows(_TASK_COLUMNS)
        tasks = (META.parse(cells, Task, where) for where, cells in rows)
    else:
        tasks = META.read_json_lines(path, Task)
    texts: dict[int, str] = {}
    for task in _some(tasks, root):
        if texts.setdefault(task.index, task.text) != task.text:
            raise META.refusal(path, f"expected each task once, found {task.index} twice")
    return texts


def _some(rows: Iterable[T], root: Path) -> list[T]:
    """All of these rows of `meta/`, refused where they never end."""
    some = list(islice(rows, _MOST_ROWS + 1))
    if len(some) > _MOST_ROWS:
        why = f"expected at most {_MOST_ROWS:,} episodes or tasks, found more"
        raise RecordingError(f"{root / 'meta'}: {why}. Split the data set")
    return some
