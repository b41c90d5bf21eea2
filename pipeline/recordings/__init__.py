"""Files on disk -> `Recording`: one entry for every format, numpy only.

`open_recordings` finds the episodes of the params' sources and reads metadata only; streams and
frames are read when asked for.
"""

import glob
import os
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.config import Source
from pipeline.errors import RecordingError
from pipeline.recordings import lerobot, pickled, raw, windowed
from pipeline.recordings.content import content_digest
from pipeline.recordings.reader import FileRecording, absolute, natural_key
from pipeline.recordings.recording import (
    ActionKind,
    CameraStream,
    Channels,
    RecordedAction,
    Recording,
    Stream,
)

__all__ = [
    "ActionKind",
    "BadEpisode",
    "CameraStream",
    "Channels",
    "Opened",
    "RecordedAction",
    "Recording",
    "RecordingError",
    "Stream",
    "content_digest",
    "open_recording",
    "open_recordings",
]


@dataclass(frozen=True)
class BadEpisode:
    """An episode whose metadata cannot be read."""

    source: str
    where: Path
    reason: str


@dataclass(frozen=True)
class Opened:
    """What the sources hold, in the order of the sources and then in natural order of paths."""

    recordings: tuple[Recording, ...]
    missing: tuple[str, ...]
    """Lines for people: episodes that `meta/` lists and whose files are not there."""
    bad: tuple[BadEpisode, ...]


Found = tuple[Sequence[FileRecording], Sequence[str]]
"""Episodes, and lines about those that are not there."""


@dataclass(frozen=True)
class _Reader:
    """A format: what marks its folders, and how one is opened."""

    marker: str
    marks: Callable[[Path, Collection[str]], bool]
    open: Callable[[Path, Source, Sequence[str] | None], Found]


def _one(
    episode: Callable[[Path, Source, Sequence[str] | None], FileRecording],
) -> Callable[[Path, Source, Sequence[str] | None], Found]:
    return lambda path, source, views: ([episode(path, source, views)], [])


READERS = {
    "new": _Reader(windowed.MARKER, windowed.is_episode, _one(windowed.WindowedRecording)),
    "old": _Reader(pickled.MARKER, pickled.is_episode, _one(pickled.PickledRecording)),
    "raw": _Reader(raw.MARKER, raw.is_episode, _one(raw.RawRecording)),
    "lerobot": _Reader(lerobot.MARKER, lerobot.is_root, lerobot.open_data_set),
}
"""In the order of detection."""


def open_recordings(
    sources: Sequence[Source], root: Path = Path(), views: Sequence[str] | None = None
) -> Opened:
    """Every episode of the sources, without reading a stream or a frame.

    A relative path of a source resolves under `root`, by default the working directory. Only the
    views in `views` are kept. Raises `RecordingError` where a path matches nothing, holds no
    episode or not those of the source's `format`, where a LeRobot `meta/` is broken, and where no
    recording has a wanted view.
    """
    recordings: list[FileRecording] = []
    missing: list[str] = []
    bad: list[BadEpisode] = []
    for source in sources:
        of_source: list[FileRecording] = []
        for folder, reader in _folders(source, root):
            try:
                found, absent = reader.open(folder, source, views)
            except RecordingError as error:
                if reader is READERS["lerobot"]:
                    raise RecordingError(f"source {source.name!r}: {error}") from None
                bad.append(BadEpisode(source.name, folder, str(error)))
                continue
            if not found:
                raise RecordingError(
                    f"source {source.name!r}: {folder} has none of the {len(absent)} episode(s) "
                    f"that its meta/ lists{'; first: ' + absent[0] if absent else ''}. "
                    "Copy the data and video files too"
                )
            of_source += found
            missing += absent
        _name_apart(of_source)
        recordings += of_source
    if views is not None:
        _check_views(recordings, views)
    return Opened(tuple(recordings), tuple(missing), tuple(bad))


def open_recording(
    path: Path, format: str, id: str, views: Sequence[str] | None = None
) -> Recording:
    """The episode that a store calls by these, alone; only the views in `views` are kept.

    Raises `RecordingError` where it is not there, or not of that format any more.
    """
    reader, source = READERS[format], Source(name=format, path=str(path))
    if not reader.marks(path, _listing(path)):
        raise RecordingError(f"{path}: not of the format {format} (no {reader.marker})")
    found, _ = reader.open(path, source, views)
    # Parent folders stand before the ids that stood more than once in a source.
    of_id = [one for one in found if format != "lerobot" or one.id == id.rpartition("/")[2]]
    if not of_id:
        raise RecordingError(f"{path}: has no episode {id}")
    return of_id[0]


def _folders(source: Source, root: Path) -> list[tuple[Path, _Reader]]:
    """The source's episode folders and LeRobot roots, each once, in natural order."""
    found: dict[Path, tuple[Path, _Reader]] = {}
    for pattern in source.paths:
        full = absolute(root / pattern)
        matches = _matches(full)
        if not matches:
            lost = "" if root.is_dir() else f": {root} is no folder; see python -m stages.doctor"
            raise RecordingError(
                f"source {source.name!r}: {pattern!r} matches nothing; looked for folders {full}. "
                f"Mend data.root or the source's path{lost}"
            )
        episodes = [pair for match in matches for pair in _episodes(match, source)]
        if not episodes:
            raise RecordingError(
                f"source {source.name!r}: {pattern!r} matches {len(matches)} folder(s), none with "
                f"an episode in it; looked under {full} for folders with "
                f"{_wanted_markers(source)}. Mend the source's path or format"
            )
        for folder, reader in episodes:
            found.setdefault(folder.resolve(), (folder, reader))
    return sorted(found.values(), key=lambda pair: natural_key(pair[0]))


def _matches(full: Path) -> list[Path]:
    """The folders that a path or glob means; a glob's end `/**` is the search that follows."""
    if full.is_dir():
        return [full]
    while full.name == "**":
        full = full.parent
    # glob follows symbolic links, as data folders often are; pathlib's ** does not.
    found = [Path(match) for match in glob.glob(str(full), recursive=True)]  # noqa: PTH207
    return sorted((path for path in found if path.is_dir()), key=natural_key)


def _episodes(
    folder: Path, source: Source, seen: frozenset[Path] = frozenset()
) -> Iterator[tuple[Path, _Reader]]:
    """Episode folders at or below a folder; nothing is looked for inside an episode."""
    names = _listing(folder)
    format = _detect(folder, names, source)
    if format is not None:
        yield folder, READERS[format]
        return
    seen |= {folder.resolve()}
    for name in sorted(names, key=natural_key):
        below = folder / name
        if not name.startswith(".") and below.is_dir() and below.resolve() not in seen:
            yield from _episodes(below, source, seen)


def _detect(folder: Path, names: Collection[str], source: Source) -> str | None:
    if source.format != "auto" and READERS[source.format].marks(folder, names):
        return source.format
    for format, reader in READERS.items():
        if reader.marks(folder, names):
            if source.format != "auto":
                raise RecordingError(
                    f"source {source.name!r}: {folder} is not of the format {source.format!r} "
                    f"that params ask for (no {READERS[source.format].marker}), it looks like "
                    f"{format!r} ({reader.marker}). Set the source's format to auto or {format}"
                )
            return format
    return None


def _listing(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be listed: {error}") from None


def _wanted_markers(source: Source) -> str:
    if source.format != "auto":
        return READERS[source.format].marker
    return ", or ".join(reader.marker for reader in READERS.values())


def _name_apart(recordings: Sequence[FileRecording]) -> None:
    """Put parent folders before the ids that stand more than once in a source."""
    parts = [
        (*absolute(r.path).parts[1:], r.id) if r.format == "lerobot" else absolute(r.path).parts[1:]
        for r in recordings
    ]
    depth = [1] * len(parts)
    while True:
        ids = ["/".join(p[-d:]) for p, d in zip(parts, depth, strict=True)]
        counts = Counter(ids)
        twins = [i for i, name in enumerate(ids) if counts[name] > 1 and depth[i] < len(parts[i])]
        if not twins:
            break
        for index in twins:
            depth[index] += 1
    for recording, name in zip(recordings, ids, strict=True):
        recording.id = name


def _check_views(recordings: Sequence[FileRecording], views: Sequence[str]) -> None:
    """Stops at the first recordings that have the views, and opens pickles last."""
    there: set[str] = set()
    for recording in sorted(recordings, key=lambda r: r.format == "old"):
        if there.issuperset(views):
            return
        try:
            there.update(recording.all_views())
        except RecordingError:
            continue  # is reported where this episode is read
    unknown = [view for view in views if view not in there]
    if unknown:
        raise RecordingError(
            f"data.views asks for {', '.join(unknown)}, which no recording has; "
            f"there are {', '.join(sorted(there, key=natural_key)) or 'none'}"
        )
