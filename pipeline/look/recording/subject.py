"""What a path on the command line is: recordings, or a store."""

import glob
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

from pipeline.base.config import InspectParams, Params, Source
from pipeline.base.errors import ConfigError, RecordingError
from pipeline.base.ownership import REPORT, refuse_foreign
from pipeline.data import Opened, open_recordings
from pipeline.data.discovery import hub_hint, meant

STORE = (".zarr", ".zarr.part")


@dataclass(frozen=True)
class Subject:
    """What is looked at: recordings, or a store.

    `name` is as the user said it, `folder` where its page goes, `store` None for recordings, whose
    relative paths begin at `root`.
    """

    name: str
    folder: Path
    store: Path | None
    sources: tuple[Source, ...]
    root: Path

    def recordings(self, views: Sequence[str] | None) -> Opened:
        """Its recordings; raises `RecordingError` where there is none that can be looked at."""
        try:
            opened = open_recordings(self.sources, self.root, views)
        except RecordingError as error:
            raise RecordingError(f"{error}{_stores_below(self.sources, self.root)}") from None
        if not opened.recordings:
            lines = [f"{self.name}: none of {len(opened.bad)} episode(s) can be looked at:"]
            lines += [f"  {bad.where}: {bad.reason}" for bad in opened.bad]
            raise RecordingError("\n".join(lines))
        return opened


def subject_of(params: Params) -> Subject:
    """What `inspect.path` names, else the recordings of `data.sources`.

    A store is known by its content or its name. Raises `ConfigError` for a path that is not there
    or is a file, for a store beside something else, and for an output that cannot be written to.
    """
    wanted = params.inspect
    places = (wanted.path,) if isinstance(wanted.path, str) else wanted.path or ()
    _check_output(wanted.output)
    folder = _folder(wanted, places)
    refuse_foreign(folder, REPORT)
    if not places:
        names = ", ".join(source.name for source in params.data.sources)
        return Subject(names, folder, None, params.data.sources, params.data.root)
    for place in places:
        _check(place, params.data.root)
    matches = [
        Path(match)
        for place in places
        for match in sorted(glob.glob(place, recursive=True)) or [place]  # noqa: PTH207
    ]
    stores = [path for path in matches if _is_store(path)]
    if stores and len(matches) > 1:
        raise ConfigError(
            f"inspect.path: {stores[0]} is a store, and {len(matches) - 1} more paths are named. "
            f"Look at it alone: python -m stages.inspect {stores[0]}"
        )
    # The last part of the first path that is no pattern.
    parts = [part for part in Path(places[0]).absolute().parts if not glob.has_magic(part)]
    name = parts[-1].strip("/") or "recordings"
    source = Source(name=name, path=tuple(places), format=wanted.format)
    return Subject(" ".join(places), folder, stores[0] if stores else None, (source,), Path())


def _check(place: str, root: Path) -> None:
    """Raise `ConfigError` for what is there and no folder, and for what is not there."""
    path = Path(place)
    if path.is_dir() or glob.has_magic(place):
        return
    if not path.exists():
        raise ConfigError(f"inspect.path: {path} is not there. {_there_is(place, root)}")
    remedy = meant(path.absolute()) or "Unpack it, or name the folder of the whole recording"
    raise ConfigError(f"inspect.path: expected a folder, found the file {path}. {remedy}")


def _check_output(folder: Path) -> None:
    """Raise `ConfigError` now for what would stop the page once everything has been read."""
    places = [folder.absolute(), *folder.absolute().parents]
    there = next(place for place in places if place.exists())
    wrong = "" if os.access(there, os.W_OK | os.X_OK) else f"{there} cannot be written to"
    if not there.is_dir():
        wrong = f"expected a folder, found the file {there}"
    for store in filter(_is_store, places):
        wrong = f"{folder} lies in the store {store}, where nothing else may be"
    if wrong:
        raise ConfigError(f"inspect.output: {wrong}. Name another: --set inspect.output=FOLDER")


def _there_is(place: str, root: Path) -> str:
    """What is there instead: below `data.root`, on the hub, or beside it, the likest first."""
    path = Path(place)
    if (root / path).exists():
        return f"It is under data.root: python -m stages.inspect '{root / path}'"
    hint = hub_hint(place, Path())
    if hint and path.parts[:1] != root.parts[:1]:  # data/demo, before the demo is written
        return hint
    parent = next(folder for folder in path.absolute().parents if folder.is_dir())
    wanted = path.absolute().relative_to(parent).parts[0]
    names = [name for name in os.listdir(parent) if not name.startswith(".")]
    close = get_close_matches(wanted, names, n=8, cutoff=0)
    return f"In {parent} there is {', '.join(close) or 'nothing'}"


def _is_store(path: Path) -> bool:
    """Whether it is a store by its content, or by its name and not of zarr v2, as none is."""
    if (path / "zarr.json").is_file():
        return True
    return path.is_dir() and path.name.endswith(STORE) and not (path / ".zgroup").exists()


def _stores_below(sources: Sequence[Source], root: Path) -> str:
    """What to say where a folder without recordings holds stores."""
    folders = [root / place for source in sources for place in source.paths]
    paths = [path for folder in folders if folder.is_dir() for path in sorted(folder.iterdir())]
    store = next(filter(_is_store, paths), None)
    return f". There is a store: python -m stages.inspect {store}" if store else ""


def _folder(wanted: InspectParams, places: Sequence[str]) -> Path:
    """The output as it was given, else a folder in it named after the paths, if any."""
    if "output" in wanted.model_fields_set or not places:
        return wanted.output
    first = os.path.relpath(places[0])
    # A path elsewhere is named by its last parts: all of it would be no name.
    parts = Path(first).parts if not first.startswith("..") else Path(places[0]).absolute().parts
    words = "_".join(parts[-3:]).replace("*", "any")
    name = re.sub(r"[^\w.-]+", "_", words).strip("_.")
    more = f"_and_{len(places) - 1}_more" if len(places) > 1 else ""
    return wanted.output / f"{name or 'here'}{more}"
