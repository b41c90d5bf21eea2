"""What lies in a folder of stores: stores, builds, archives, locks; their sizes and what they hold.

Reads metadata and a few small arrays only, whatever the size. A damaged store is listed with the
reason; it stops nothing.
"""

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

from pipeline.base.errors import ConfigError, PipelineError
from pipeline.store.archive import is_archive
from pipeline.store.housekeeping.contents import Contents, contents_of, contents_of_archive
from pipeline.store.lock import lock_holder
from pipeline.store.paths import read_plan
from pipeline.store.reader import FeatureStore

GROUPS: tuple[str, ...] = ("features", "sensor", "state", "rest")
Kind = Literal[
    "store",
    "archive",
    "build",
    "repair",
    "set aside",
    "replaced",
    "previous",
    "lock",
    "ledger",
    "unknown",
]

_SUFFIXES: Mapping[str, Kind] = {
    "": "store",
    ".part": "build",
    ".repair.part": "repair",
    ".known": "set aside",
    ".old": "replaced",
    ".replaced": "replaced",
    ".keeping": "replaced",
    ".previous": "previous",
    ".lock": "lock",
    ".wait": "lock",
    ".files.sqlite": "ledger",
}
_NAME = re.compile(
    rf"(?P<base>.+?\.zarr)(?:(?P<suffix>{'|'.join(re.escape(one) for one in _SUFFIXES if one)})"
    r"(?:-(?:\d+|wal|shm))?)?"
)
_UNREADABLE = (PipelineError, OSError, ValueError, KeyError, TypeError, AttributeError, IndexError)


@dataclass(frozen=True)
class Entry:
    """One thing in a folder of stores."""

    path: Path
    kind: Kind
    base: Path
    """The store that it is, or belongs to."""
    sizes: Mapping[str, int]
    """Bytes on the disk by group of arrays; files that are hard links counted like others."""
    files: Mapping[tuple[int, int], int] = field(repr=False)
    """Bytes on the disk of each file, by device and inode."""
    links: int = 0
    """Names that its files have, on the whole file system."""
    contents: Contents | None = None
    damage: str | None = None
    """Why it cannot be used, if so."""

    @property
    def bytes(self) -> int:
        """On the disk."""
        return sum(self.sizes.values())


@dataclass(frozen=True)
class Inventory:
    """Everything in a folder that belongs to a store, by path."""

    folder: Path
    entries: tuple[Entry, ...]

    @property
    def bytes(self) -> int:
        """On the disk, each hard-linked file once."""
        return sum({key: size for one in self.entries for key, size in one.files.items()}.values())

    def of_kind(self, *kinds: Kind) -> list[Entry]:
        """The entries of these kinds."""
        return [one for one in self.entries if one.kind in kinds]

    def siblings(self, entry: Entry) -> dict[Path, int]:
        """Other entries that share files with this one by hard links -> bytes shared."""
        shared = {
            one.path: sum(entry.files[key] for key in entry.files.keys() & one.files.keys())
            for one in self.entries
            if one is not entry
        }
        return {path: count for path, count in shared.items() if count}

    def linked_elsewhere(self, entry: Entry) -> bool:
        """Whether its files have names that are in no entry, such as in a cache of DVC's."""
        here = sum(len(entry.files.keys() & one.files.keys()) for one in self.entries)
        return entry.links > here

    def archives_of(self, entry: Entry) -> list[Entry]:
        """The archives that were made of a store."""
        plan = entry.contents.plan if entry.contents else None
        return [
            one
            for one in self.of_kind("archive")
            if plan is not None and one.contents is not None and one.contents.plan == plan
        ]

    @cached_property
    def holders(self) -> dict[Path, str]:
        """Stores that a living process is building -> that process, as its lock says."""
        return {
            one.base: holder
            for one in self.of_kind("lock")
            if (holder := lock_holder(one.path)) is not None
        }


def take_inventory(folder: Path, *, subfolders: bool = True) -> Inventory:
    """Everything in `folder` and its subfolders that belongs to a store.

    Raises `ConfigError` where there is no such folder.
    """
    if not folder.is_dir():
        raise ConfigError(
            f"stores.folder: expected a folder of stores, found none at {folder}. Name it with "
            "--set stores.folder=…"
        )
    return Inventory(folder, tuple(_entry(*found) for found in _walk(folder, subfolders)))


def _walk(folder: Path, subfolders: bool) -> Iterator[tuple[Path, Kind, Path]]:
    """What belongs to a store, at or below a folder; links to folders are not followed."""
    for path in sorted(folder.iterdir()):
        match = _NAME.fullmatch(path.name)
        if match:
            yield path, _SUFFIXES[match["suffix"] or ""], path.with_name(match["base"])
        elif path.name.endswith(".partial"):
            yield path, "unknown", path
        elif subfolders and path.is_dir() and not path.is_symlink():
            yield from _walk(path, subfolders)


def _entry(path: Path, kind: Kind, base: Path) -> Entry:
    sizes, files, links = _disk(path)
    contents, damage = None, None
    try:
        if kind == "store" and is_archive(path):
            kind, contents = "archive", contents_of_archive(path)
        elif kind == "store":
            FeatureStore.open(path)
            contents = contents_of(path)
        elif kind in ("build", "set aside", "replaced", "previous") and read_plan(path) is not None:
            contents = contents_of(path)
    except _UNREADABLE as error:
        damage = str(error) if isinstance(error, PipelineError) else f"{path}: {error!r}"
    return Entry(path, kind, base, sizes, files, links, contents, damage)


def _disk(path: Path) -> tuple[dict[str, int], dict[tuple[int, int], int], int]:
    """Bytes on the disk by group and by file, and the names that these files have."""
    sizes, files, links = dict[str, int].fromkeys(GROUPS, 0), dict[tuple[int, int], int](), 0
    for place in _files(path):
        try:
            status = place.stat()  # of the file itself where a cache hands out symbolic links
        except FileNotFoundError:
            continue  # removed meanwhile, or a link into a cache that was emptied
        size = status.st_blocks * 512
        sizes[_group(place.relative_to(path))] += size
        files[status.st_dev, status.st_ino] = size
        links += status.st_nlink
    return sizes, files, links


def _files(path: Path) -> Iterator[Path]:
    if not path.is_dir():
        yield path
    for folder, _, names in os.walk(path):
        yield from (Path(folder, name) for name in names)


def _group(inside: Path) -> str:
    parts = inside.parts
    if parts[:2] == ("vl", "features"):
        return "features"
    return parts[0] if parts and parts[0] in GROUPS else "rest"
