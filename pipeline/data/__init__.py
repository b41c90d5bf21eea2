"""Files on disk -> `Recording`, for every format; numpy only.

`open_recordings` finds the episodes of the params' sources and reads metadata only; streams and
frames are read on demand.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.config import Source
from pipeline.base.errors import RecordingError
from pipeline.data.discovery import READERS, episode_folders
from pipeline.data.recording import (
    ActionKind,
    CameraStream,
    Channels,
    RecordedAction,
    Recording,
    Stream,
    absolute,
    content_digest,
    natural_key,
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
    """The episodes of all sources, in the order of the sources, then in natural order of paths."""

    recordings: tuple[Recording, ...]
    missing: tuple[str, ...]
    """One line for each episode that a LeRobot `meta/` lists but whose files are missing."""
    bad: tuple[BadEpisode, ...]


def open_recordings(
    sources: Sequence[Source], root: Path = Path(), views: Sequence[str] | None = None
) -> Opened:
    """Every episode of the sources, without reading a stream or a frame.

    A relative path of a source resolves under `root`, by default the working directory. Only the
    views in `views` are kept. Raises `RecordingError` where a path matches nothing, has no episode
    or episodes of another format than the source's `format`, where a LeRobot `meta/` is broken, and
    where no recording has a wanted view.
    """
    recordings: list[Recording] = []
    missing: list[str] = []
    bad: list[BadEpisode] = []
    for source in sources:
        of_source: list[Recording] = []
        for folder, reader in episode_folders(source, root):
            try:
                episodes, absent = reader.open(folder, source, views)
            except RecordingError as error:
                if reader is READERS["lerobot"]:
                    raise RecordingError(f"source {source.name!r}: {error}") from None
                bad.append(BadEpisode(source.name, folder, str(error)))
                continue
            if not episodes:
                raise RecordingError(
                    f"source {source.name!r}: {folder} has none of the {len(absent)} episode(s) "
                    f"that its meta/ lists{'; first: ' + absent[0].rstrip('.') if absent else ''}. "
                    "Copy the data and video files too, or correct the paths in meta/info.json."
                )
            of_source += episodes
            missing += absent
        _name_apart(of_source)
        recordings += of_source
    if views is not None:
        _check_views(recordings, views)
    return Opened(tuple(recordings), tuple(missing), tuple(bad))


def _name_apart(recordings: Sequence[Recording]) -> None:
    """Put parent folders before ids that occur more than once in a source."""
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


def _check_views(recordings: Sequence[Recording], views: Sequence[str]) -> None:
    """Raise `RecordingError` where no recording has a wanted view.

    It reads recordings until all views were seen, pickles last.
    """
    known: set[str] = set()
    for recording in sorted(recordings, key=lambda r: r.format == "old"):
        if known.issuperset(views):
            return
        try:
            known.update(recording.all_views())
        except RecordingError:
            continue  # reported where the episode is read
    unknown = [view for view in views if view not in known]
    if unknown:
        raise RecordingError(
            f"data.views asks for {', '.join(unknown)}, which no recording has; "
            f"there are {', '.join(sorted(known, key=natural_key)) or 'none'}. "
            "Set data.views to some of these, or to null for all"
        )
