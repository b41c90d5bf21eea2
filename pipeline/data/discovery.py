"""Where the episodes of a source lie, and in which format."""

import glob
import os
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from fnmatch import filter as matching
from itertools import chain, islice
from pathlib import Path

from pipeline.base.border import shown
from pipeline.base.commands import command
from pipeline.base.config import Source
from pipeline.base.errors import RecordingError
from pipeline.data import lerobot, pickled, raw, windowed
from pipeline.data.hub import hub_folder
from pipeline.data.recording import Recording, absolute, entries, natural_key

Opener = Callable[[Path, Source, Sequence[str] | None], tuple[Sequence[Recording], Sequence[str]]]
"""Opens a folder: its episodes, and one line for each missing episode."""


@dataclass(frozen=True)
class FormatReader:
    """How a format's folders are recognised and opened."""

    marker: str
    marks: Callable[[Path, Collection[str]], bool]
    open: Opener


def _single(episode: Callable[[Path, Source, Sequence[str] | None], Recording]) -> Opener:
    """The opener of a format with one episode per folder."""
    return lambda path, source, views: ([episode(path, source, views)], [])


READERS = {
    "new": FormatReader(windowed.MARKER, windowed.is_episode, _single(windowed.WindowedRecording)),
    "old": FormatReader(pickled.MARKER, pickled.is_episode, _single(pickled.PickledRecording)),
    "raw": FormatReader(raw.MARKER, raw.is_episode, _single(raw.RawRecording)),
    "lerobot": FormatReader(lerobot.MARKER, lerobot.is_root, lerobot.open_data_set),
}
"""In the order of detection."""

_FOREIGN = {
    "*.tfrecord* *.tfrecords*": "RLDS, the TFRecord files of Open X-Embodiment",
    ".zgroup .zarray": "a zarr replay buffer, as UMI and Diffusion Policy write them",
    "*.hdf5 *.h5": "HDF5, as robomimic and ALOHA write it",
    "*.bag *.mcap *.db3": "a ROS bag",
    "*.parquet": "LeRobot without its meta/info.json, or other parquet files",
    "*.npz *.npy *.csv *.tsv *.pkl *.pickle *.pt": "arrays or tables of another recorder",
    "*.mp4 *.avi *.mkv *.mov *.webm *.jpg *.jpeg *.png": "images alone, without their actions",
}
"""Formats without a reader, by file name patterns; the first match decides."""

_ON_THE_HUB = (
    "For a data set on the Hugging Face Hub, give the source hub: owner/name in place of path"
)

_ODD = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")
"""Control characters, and bytes of a name that are not UTF-8."""
_MOST_LOOKED_AT = 1000
"""Most folders searched for such names."""
_DEEPEST = 4
"""Levels below a LeRobot root at which its files lie: videos/chunk-000/view/episode.mp4."""


def episode_folders(source: Source, root: Path) -> list[tuple[Path, FormatReader]]:
    """The source's episode folders and LeRobot roots, each once, in natural order.

    Raises `RecordingError` where a path has none, and where a name is not UTF-8 or has control
    characters, because a store could not keep it.
    """
    unique: dict[Path, tuple[Path, FormatReader]] = {}
    for pattern in source.paths if source.hub is None else [str(hub_folder(source))]:
        full = absolute(root / pattern)
        matches = _matches(full)
        if not matches:
            lost = "" if root.is_dir() else f": {root} is no folder; see {command('doctor')}"
            files = glob.glob(str(full), recursive=True)  # noqa: PTH207
            hint = meant(Path(files[0]) if files else full) or _ON_THE_HUB
            raise RecordingError(
                f"source {source.name!r}: {pattern!r} matches nothing; looked for folders {full}. "
                f"Mend data.root or the source's path{lost}. {hint}"
            )
        episodes = [pair for match in matches for pair in _episodes(match, source)]
        if not episodes:
            wanted = [source.format] if source.format in READERS else list(READERS)
            markers = ", or ".join(READERS[format].marker for format in wanted)
            raise RecordingError(
                f"source {source.name!r}: {pattern!r} matches {len(matches)} folder(s), none with "
                f"an episode in it; looked under {full} for folders with {markers}. "
                f"{meant(matches[0]) or 'Mend the path or format'}"
            )
        for folder, reader in episodes:
            _check_name(source, folder)
            unique.setdefault(folder.resolve(), (folder, reader))
    return sorted(unique.values(), key=lambda pair: natural_key(pair[0]))


def _matches(full: Path) -> list[Path]:
    """The folders of a path or glob; a final `/**` is dropped, because all below is searched."""
    if _is_folder(full):
        return [full]
    while full.name == "**":
        full = full.parent
    # glob follows symbolic links, as data folders often are; pathlib's ** does not.
    matches = [Path(match) for match in glob.glob(str(full), recursive=True)]  # noqa: PTH207
    return sorted(filter(_is_folder, matches), key=natural_key)


def _is_folder(path: Path) -> bool:
    return os.path.isdir(path)  # noqa: PTH112, it accepts a name that is too long


def _episodes(start: Path, source: Source) -> Iterator[tuple[Path, FormatReader]]:
    """Episode folders at or below a folder; does not search inside an episode."""
    pending, seen = [start], set[tuple[int, int]]()
    while pending:
        folder = pending.pop()
        listed, status = entries(folder), folder.stat()
        if (status.st_dev, status.st_ino) in seen:
            continue
        seen.add((status.st_dev, status.st_ino))
        format = _detect(folder, [entry.name for entry in listed], source)
        if format is not None:
            yield folder, READERS[format]
        else:
            below = (entry for entry in listed if not entry.name.startswith("."))
            # A listing tells folders from files without a call for each.
            pending += [
                Path(entry.path)
                for entry in below
                if (_is_folder(Path(entry.path)) if entry.is_symlink() else entry.is_dir())
            ]


def _detect(folder: Path, names: Collection[str], source: Source) -> str | None:
    if source.format != "auto" and READERS[source.format].marks(folder, names):
        return source.format
    format = _format(folder, names)
    if format is not None and source.format != "auto":
        raise RecordingError(
            f"source {source.name!r}: {folder} is not of the format {source.format!r} that params "
            f"ask for (no {READERS[source.format].marker}), it looks like {format!r} "
            f"({READERS[format].marker}). Set the source's format to auto or {format}"
        )
    return format


def meant(path: Path) -> str:
    """A hint about a path without an episode: its parent episode or its format; '' if unknown."""
    for folder in path.parents[:_DEEPEST]:
        if not (folder.is_dir() and os.access(folder, os.R_OK)):
            continue
        format = _format(folder, listing(folder))
        if format is not None:
            what = "a LeRobot data set" if format == "lerobot" else f"an episode ({format!r})"
            return f"Did you mean {folder}, which is {what}?"
    return _foreign(path)


def _foreign(path: Path) -> str:
    """A hint about a format without a reader, and what to do; '' if unknown.

    Zarr v3 groups, such as this project's stores, are skipped.
    """
    if not os.path.exists(path):  # noqa: PTH110, it accepts a name that is too long
        return ""
    names = {path.name.lower()}
    for _, below, files in islice(os.walk(path), _MOST_LOOKED_AT):
        if "zarr.json" in files:
            below.clear()
        else:
            names |= {name.lower() for name in (*below, *files)}
    for patterns, what in _FOREIGN.items():
        fitting = sorted(chain.from_iterable(matching(names, end) for end in patterns.split()))
        if fitting:
            return (
                f"It looks like {what} ({fitting[0]}), which this project does not read. Convert "
                "it to LeRobot, or write a reader: docs/recipes/reader.md"
            )
    return ""


def _check_name(source: Source, folder: Path) -> None:
    if odd := _ODD.search(str(folder)):
        raise RecordingError(
            f"source {source.name!r}: the name of {shown(str(folder))} is not UTF-8 or holds a "
            f"control character, {shown(odd[0])}, which no store could keep. Rename the folder"
        )


def _format(folder: Path, names: Collection[str]) -> str | None:
    return next((name for name, reader in READERS.items() if reader.marks(folder, names)), None)


def listing(folder: Path) -> list[str]:
    """The names in a folder; `RecordingError` where it cannot be read."""
    return [entry.name for entry in entries(folder)]
