"""What is in a folder of stores, as a table for people, and what a stopped build left in it.

Only metadata and a few small arrays are read, whatever the size. A damaged store is listed with the
reason and does not stop the list.
"""

import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pipeline.base.arrays import packed_dim
from pipeline.base.errors import ConfigError, PipelineError, StoreLocked
from pipeline.base.files import remove_folder
from pipeline.base.printed_commands import command
from pipeline.base.text import Table, size
from pipeline.store.archive import is_archive, read_manifest
from pipeline.store.chunks import read_rows
from pipeline.store.documents import StoreAttributes
from pipeline.store.lock import build_lock, is_locked
from pipeline.store.paths import (
    KEPT,
    STORE,
    builds_aside,
    is_store,
    laid_out_attributes,
    recover,
)
from pipeline.store.reader import FeatureStore
from pipeline.store.schema import CHECKSUMS, FEATURES, ArraySpec, read_spec, read_specs

# The kind of an entry, by the suffix after the store's name.
_KINDS = {None: "store", ".part": "build", ".previous": "previous"}
_NAME = re.compile(r"(?P<base>.+?\.zarr)(?P<suffix>\.[a-z]+)?")


@dataclass(frozen=True)
class StoreEntry:
    """A store, an archive, a build of the store `base`, or the one before it.

    `bytes` is its size on the disk. Stores and builds have `attributes` and `specs`; `done` counts
    the feature rows that are there. `damage` is the reason why an entry cannot be used.
    """

    path: Path
    kind: str
    base: Path
    bytes: int
    attributes: StoreAttributes | None = None
    specs: Mapping[str, ArraySpec] = field(default_factory=dict)
    done: int = 0
    damage: str | None = None


def list_stores(folder: Path) -> list[StoreEntry]:
    """Everything in `folder` and its subfolders that belongs to a store, sorted by path.

    Raises `ConfigError` where there is no such folder.
    """
    if not folder.is_dir():
        raise ConfigError(
            f"stores.folder: expected a folder of stores, found none at {folder}. Name it with "
            "--set stores.folder=…"
        )
    return [*_walk(folder)]


def describe_stores(
    folder: Path, entries: Sequence[StoreEntry], dependents: Mapping[Path, Sequence[str]]
) -> list[str]:
    """Lines for people: a table with the `dependents` below each store, then the feature specs."""
    if not entries:
        return [f"{folder}: no store in it"]
    heads = ("", "what", "on disk", "episodes", "ticks", "VL rows", "spec")
    header, *rows = Table(heads, [_row(folder, entry) for entry in entries]).text()
    lines = [header]
    for entry, row in zip(entries, rows, strict=True):
        lines += [
            row,
            *(f"    {line}" for line in (*_details(entry), *dependents.get(entry.path, ()))),
        ]
    specs = dict(_spec(entry) for entry in entries if entry.attributes)
    return [*lines, "", *(f"spec {digest}: {text}" for digest, text in specs.items())]


def is_unneeded(entry: StoreEntry) -> bool:
    """Whether an entry is a build that stopped before any row was done."""
    empty = entry.kind == "build" and not entry.done and not entry.damage
    return empty and not entry.path.is_symlink() and not is_locked(entry.base)


def leftover(path: Path) -> StoreEntry:
    """The unfinished build or the previous store at a path.

    Raises `ConfigError` where there is something else.
    """
    entry = _entry(path)
    if entry is None or entry.kind not in ("build", "previous") or not path.is_dir():
        raise ConfigError(
            f"stores.inputs: {path}: expected an unfinished build or a previous store. Nothing was "
            f"removed; {command('store', 'gc')} lists what may be."
        )
    return entry


def remove_leftover(entry: StoreEntry) -> None:
    """Remove a build or a previous store; a store that a kill left in the build is put back first.

    Raises `StoreLocked` where a process is building or has added rows since, and `ConfigError`
    where this project did not write what is there, and for a previous store without the store that
    replaced it: a kill left it as the only copy.
    """
    with build_lock(entry.base):
        recover(entry.base)
        now = _entry(entry.path)
        if now is not None and now.done > entry.done:
            raise StoreLocked(f"{entry.path}: a build went on meanwhile. It was left as it is.")
        if entry.kind == "previous" and not is_store(entry.base):
            raise ConfigError(
                f"{entry.path}: expected the store that replaced it, found none at {entry.base}. "
                "It was left as it is: run the extraction again, or rename it to that name."
            )
        remove_folder(entry.path, KEPT if entry.kind == "previous" else STORE)


def _walk(folder: Path) -> Iterator[StoreEntry]:
    """Everything that belongs to a store, in or below a folder; does not follow links."""
    for path in sorted(folder.iterdir()):
        if (entry := _entry(path)) is not None:
            yield entry
        elif path.is_dir() and not path.is_symlink():
            yield from _walk(path)


def _entry(path: Path) -> StoreEntry | None:
    """What is at a path; None where its name is not that of a store, build or previous store."""
    name = _NAME.fullmatch(path.name)
    if name is None or name["suffix"] not in _KINDS:
        return None
    kind = _KINDS[name["suffix"]]
    entry = StoreEntry(path, kind, path.with_name(name["base"]), bytes_on_disk(path))
    try:
        if kind != "store" and not (STORE if kind == "build" else KEPT).owns(path):
            return None
        if kind == "store" and is_archive(path):
            read_manifest(path)
            return replace(entry, kind="archive")
        if kind == "store":
            FeatureStore.open(path)
        builds = builds_aside(entry.base) if kind == "build" else []
        done = sum(map(_done, filter(is_store, (path, *builds))))
        if is_store(path):
            root, specs = laid_out_attributes(path), read_specs(path)
            return replace(entry, attributes=root, specs=specs, done=done)
        return replace(entry, done=done)
    except PipelineError as error:  # list the others
        return replace(entry, damage=str(error))
    except OSError as error:  # removed meanwhile, or unreadable
        return replace(entry, damage=f"{path}: {error.strerror}")


def bytes_on_disk(path: Path) -> int:
    """Bytes on the disk; a hard-linked file counts once."""
    used: dict[tuple[int, int], int] = {}
    for file in path.rglob("*") if path.is_dir() else [path]:
        with suppress(OSError):  # removed meanwhile, or a link into an emptied cache
            status = file.stat()  # follows the symbolic links of a cache
            if not stat.S_ISDIR(status.st_mode):
                used[status.st_dev, status.st_ino] = status.st_blocks * 512
    return sum(used.values())


def _done(store: Path) -> int:
    """How many feature rows a store or build has."""
    return int(np.count_nonzero(read_rows(store, read_spec(store, CHECKSUMS))))


def _row(folder: Path, entry: StoreEntry) -> tuple[object, ...]:
    name = entry.path.relative_to(folder).as_posix()
    row = (name, "damaged" if entry.damage else entry.kind, size(entry.bytes))
    if entry.attributes is None:
        return (*row, None, None, None, None)
    arrays = ("episode/source", "tick/time", FEATURES)
    episodes, ticks, rows = (entry.specs[array].shape[0] for array in arrays)
    done = rows if entry.done == rows else f"{entry.done:,} of {rows:,}"
    return (*row, episodes, ticks, done, _spec(entry)[0])


def _details(entry: StoreEntry) -> Iterator[str]:
    if entry.damage:
        # What is wrong, without the advice after it.
        yield f"damaged: {entry.damage.split('. ', 1)[0].splitlines()[0]}"
    if entry.kind == "build" and is_locked(entry.base):
        yield "being built"


def _spec(entry: StoreEntry) -> tuple[str, str]:
    """The first digits of a feature spec's digest, and what its features are."""
    assert entry.attributes is not None
    features, document = entry.specs[FEATURES], entry.attributes.raw["feature_spec"]
    slots = [
        f"{slot.pooling} of {'the vision tower' if slot.layer == 'vision' else slot.layer}"
        for slot in entry.attributes.slots
    ]
    return entry.attributes.feature_spec.digest[:8], (
        f"{features.shape[1]} slots x {packed_dim(features.stored_dtype, features.shape[2])} in "
        f"{features.stored_dtype}, {' + '.join(dict.fromkeys(slots))}, prompt "
        f"{document.get('prompt')}"
    )
