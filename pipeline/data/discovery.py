"""Where the episodes of a source lie, and in which format."""

import glob
import os
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.config import Source
from pipeline.base.documents import shown
from pipeline.base.errors import ConfigError, RecordingError
from pipeline.base.hub import network_errors
from pipeline.base.printed_commands import command
from pipeline.data import lerobot, pickled, raw, windowed
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

_ODD = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")
"""Control characters, and bytes of a name that are not UTF-8."""


def episode_folders(source: Source, root: Path) -> list[tuple[Path, FormatReader]]:
    """The source's episode folders and LeRobot roots, each once, in natural order.

    Raises `RecordingError` where a path has none, and where a name is not UTF-8 or has control
    characters, because a store could not keep it.
    """
    unique: dict[Path, tuple[Path, FormatReader]] = {}
    for pattern in source.paths if source.hub is None else [str(_hub_folder(source))]:
        full = absolute(root / pattern)
        matches = _matches(full)
        if not matches:
            raise RecordingError(
                f"source {source.name!r}: {pattern!r} matches nothing; looked for folders {full}. "
                f"Mend data.root or the source's path; `{command('doctor')}` looks at both. For a "
                "data set on the Hugging Face Hub, give hub: owner/name in place of path"
            )
        episodes = [pair for match in matches for pair in _episodes(match, source)]
        if not episodes:
            markers = ", or ".join(reader.marker for reader in READERS.values())
            raise RecordingError(
                f"source {source.name!r}: {pattern!r} matches {len(matches)} folder(s), none with "
                f"an episode in it; looked under {full} for folders with {markers}. Mend the path; "
                "convert another format to LeRobot, or write a reader: docs/recipes/reader.md"
            )
        for folder, reader in episodes:
            _check_name(source, folder)
            unique.setdefault(folder.resolve(), (folder, reader))
    return sorted(unique.values(), key=lambda pair: natural_key(pair[0]))


def _hub_folder(source: Source) -> Path:
    """The folder of a source's data set in the Hub's cache.

    Files that the Hub's cache lacks are downloaded; without network, what it has of that revision
    is used. Raises `ConfigError` where there is neither.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HFValidationError

    assert source.hub is not None
    repo, _, revision = source.hub.partition("@")
    try:
        return Path(snapshot_download(repo, repo_type="dataset", revision=revision or None))
    except (HFValidationError, *network_errors()) as error:
        why = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
        at = f" --revision {revision}" if revision else ""
        raise ConfigError(
            f"source {source.name!r}: hub {source.hub}: cannot be downloaded: {why}. Look at the "
            f"id, or run `hf download --repo-type dataset {repo}{at}` where there is network and "
            "give its folder as the source's path. A gated set needs `hf auth login`"
        ) from error


def _matches(full: Path) -> list[Path]:
    """The folders of a path or glob."""
    if _is_folder(full):
        return [full]
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
            below = (Path(entry.path) for entry in listed if not entry.name.startswith("."))
            pending += filter(_is_folder, below)


def _detect(folder: Path, names: Collection[str], source: Source) -> str | None:
    marked = [format for format, reader in READERS.items() if reader.marks(folder, names)]
    if source.format == "auto" or not marked or source.format in marked:
        return source.format if source.format in marked else next(iter(marked), None)
    raise RecordingError(
        f"source {source.name!r}: expected the format {source.format!r}, found {marked[0]!r} in "
        f"{folder} ({READERS[marked[0]].marker}). Set the source's format to auto or {marked[0]}"
    )


def _check_name(source: Source, folder: Path) -> None:
    if odd := _ODD.search(str(folder)):
        raise RecordingError(
            f"source {source.name!r}: the name of {shown(str(folder))} is not UTF-8 or holds a "
            f"control character, {shown(odd[0])}, which no store could keep. Rename the folder"
        )
