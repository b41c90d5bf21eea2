"""The subject of an inspection: recordings, or a store."""

import glob
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.config import InspectParams, Params, Source
from pipeline.base.errors import ConfigError, RecordingError
from pipeline.base.files import REPORT, refuse_foreign
from pipeline.data import Opened, open_recordings

STORE = (".zarr", ".zarr.part")


@dataclass(frozen=True)
class Subject:
    """What is inspected: recordings, or a store.

    `name` is the user's name for it, `folder` the place of the page. `store` is None for
    recordings; their relative paths begin at `root`.
    """

    name: str
    folder: Path
    store: Path | None
    sources: tuple[Source, ...]
    root: Path

    def recordings(self, views: Sequence[str] | None) -> Opened:
        """Its recordings; raises `RecordingError` where none can be opened."""
        opened = open_recordings(self.sources, self.root, views)
        if not opened.recordings:
            lines = [f"{self.name}: none of {len(opened.bad)} episode(s) can be looked at:"]
            lines += [f"  {bad.where}: {bad.reason}" for bad in opened.bad]
            raise RecordingError("\n".join(lines))
        return opened


def subject_of(params: Params) -> Subject:
    """The subject at `inspect.path`, or the recordings of `data.sources` without a path.

    A store is known by its content or its name. Raises `ConfigError` for a path that is not there
    or is a file, and for an output that holds something else.
    """
    wanted = params.inspect
    places = (wanted.path,) if isinstance(wanted.path, str) else wanted.path or ()
    folder = _folder(wanted, places)
    for place in (wanted.output, folder):
        refuse_foreign(place, REPORT)
    if not places:
        names = ", ".join(source.name for source in params.data.sources)
        return Subject(names, folder, None, params.data.sources, params.data.root)
    for path in (Path(place) for place in places if not glob.has_magic(place)):
        if not path.is_dir():
            thing = f"the file {path}" if path.exists() else f"nothing at {path}"
            raise ConfigError(
                f"inspect.path: expected a folder, found {thing}. Name recordings or a store"
            )
    matches = [
        Path(match)
        for place in places
        for match in sorted(glob.glob(place, recursive=True)) or [place]  # noqa: PTH207
    ]
    # The last part of the first path that is not a pattern.
    parts = [part for part in Path(places[0]).absolute().parts if not glob.has_magic(part)]
    name = parts[-1].strip("/") or "recordings"
    source = Source(name=name, path=tuple(places), format=wanted.format)
    store = matches[0] if len(matches) == 1 and _is_store(matches[0]) else None
    return Subject(" ".join(places), folder, store, (source,), Path())


def _is_store(path: Path) -> bool:
    """Whether it is a store, by its content or by its name; a zarr v2 group is never one."""
    if (path / "zarr.json").is_file():
        return True
    return path.is_dir() and path.name.endswith(STORE) and not (path / ".zgroup").exists()


def _folder(wanted: InspectParams, places: Sequence[str]) -> Path:
    """The output if it was set, else a folder in it named after the first path."""
    if "output" in wanted.model_fields_set or not places:
        return wanted.output
    first = os.path.relpath(places[0])
    # A path elsewhere is named by its last parts.
    parts = Path(first).parts if not first.startswith("..") else Path(places[0]).absolute().parts
    words = "_".join(parts[-3:]).replace("*", "any")
    name = re.sub(r"[^\w.-]+", "_", words).strip("_.")
    more = f"_and_{len(places) - 1}_more" if len(places) > 1 else ""
    return wanted.output / f"{name or 'here'}{more}"
