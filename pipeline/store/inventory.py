"""What is in a folder of stores, as a table for people, and which of it may be removed.

Only metadata and a few small arrays are read, whatever the size. A damaged store is listed with the
reason and does not stop the list. Never removed are a finished store or its only copy, an archive,
a build of a living process, anything that this project did not write, and anything behind a
symbolic link. A build with feature rows is removed only by name, because the next run resumes it or
takes its rows.
"""

import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from glob import escape
from pathlib import Path
from textwrap import shorten
from typing import Literal

import numpy as np

from pipeline.base.arrays import packed_dim
from pipeline.base.commands import command
from pipeline.base.digests import LEDGER_SUFFIX, is_ledger
from pipeline.base.errors import ConfigError, PipelineError, StoreIncomplete, StoreLocked
from pipeline.base.files import REPLACED, OutputKind, remove_folder
from pipeline.base.text import Table, size
from pipeline.store.archive import ARCHIVE, is_archive, read_manifest
from pipeline.store.border import KNOWN, StoreAttributes, gc_command
from pipeline.store.chunks import read_rows
from pipeline.store.lock import build_lock, lock_holder
from pipeline.store.paths import (
    ASIDE_METADATA,
    KEPT,
    STORE,
    is_store,
    laid_out_attributes,
)
from pipeline.store.reader import FeatureStore
from pipeline.store.schema import CHECKSUMS, FEATURES, ArraySpec, read_spec, read_specs

Fate = Literal["unneeded", "by name", "kept"]

# The kind of an entry, by the suffix after the store's name.
_KINDS = {
    None: "store",
    ".part": "build",
    ".previous": "previous",
    ".lock": "lock",
    LEDGER_SUFFIX: "ledger",
}
_NAME = re.compile(r"(?P<base>.+?\.zarr)(?P<suffix>\.[a-z.]+?)?(?:-(?:wal|shm))?")
_SPEC_ENTRIES = ("processor", "weights", "adapter", "compute_dtype", "variants", "prompt")


@dataclass(frozen=True)
class StoreEntry:
    """A store, an archive, or something beside the store `base` that belongs to it.

    `bytes` is its size on the disk. Stores, archives and builds have `attributes` and `specs`;
    `done` counts the feature rows that are there. `damage` is the reason why an entry cannot be
    used, `holder` the living process that holds the lock of `base`.
    """

    path: Path
    kind: str
    base: Path
    bytes: int
    attributes: StoreAttributes | None = None
    specs: Mapping[str, ArraySpec] = field(default_factory=dict)
    done: int = 0
    damage: str | None = None
    holder: str | None = None


def list_stores(folder: Path, *, subfolders: bool = True) -> list[StoreEntry]:
    """Everything in `folder` and its subfolders that belongs to a store, sorted by path.

    Raises `ConfigError` where there is no such folder.
    """
    if not folder.is_dir():
        raise ConfigError(
            f"stores.folder: expected a folder of stores, found none at {folder}. Name it with "
            "--set stores.folder=…"
        )
    return [_entry(*place) for place in _walk(folder, subfolders)]


def describe_stores(
    folder: Path, entries: Sequence[StoreEntry], dependents: Mapping[Path, Sequence[str]]
) -> list[str]:
    """Lines for people: a table with the `dependents` below each store, then the feature specs."""
    listed = [entry for entry in entries if entry.kind != "lock"]
    if not listed:
        return [f"{folder}: no store in it"]
    heads = ("", "what", "on disk", "episodes", "ticks", "VL rows", "spec")
    header, *rows = Table(heads, [_row(folder, entry) for entry in listed]).text()
    lines = [header]
    for entry, row in zip(listed, rows, strict=True):
        details = [*_details(entry), *dependents.get(entry.path, ())]
        lines += [row, *(f"    {line}" for line in details)]
    specs = dict(_spec(entry) for entry in listed if entry.attributes)
    return [*lines, "", *(f"spec {digest}: {text}" for digest, text in specs.items())]


def fate_of(entry: StoreEntry) -> tuple[Fate, str]:
    """Whether an entry may be removed (always, only by name, or never), and the reason.

    Looks at the disk again, because its neighbours may have changed since it was listed.
    """
    path, kind = entry.path, entry.kind
    if kind in ("store", "archive"):
        return "kept", f"a finished {kind}, which is never removed here"
    if path.is_symlink():
        return "kept", "a symbolic link, left alone"
    if not _is_ours(entry):
        return "kept", "this project did not write it, left alone"
    if entry.holder:
        return "kept", f"in use by {entry.holder}"
    if kind == "lock":
        return "unneeded", "held by no process"
    if kind == "ledger":
        if any(other.is_dir() for other in path.parent.glob(f"{escape(entry.base.name)}*")):
            return "kept", "content digests for a store that is there"
        return "unneeded", "content digests for a store that is not there"
    held = path if kind == "previous" else path / REPLACED  # a finished store
    try:
        stores = list(filter(is_store, (path, held, *(path / KNOWN).glob("*"))))
        done = sum(map(_done, stores))
    except PipelineError as error:
        return "by name", f"unfinished build that cannot be read: {_first_clause(str(error))}"
    if held in stores and not entry.base.exists():
        return "kept", f"the only copy of {entry.base.name}, which a killed replacement left there"
    if kind == "previous":
        return "by name", "the store before, kept until the next run that changes the store"
    if done:
        return "by name", f"unfinished build with {done} feature rows; the same command goes on"
    if any(path.glob(f"{KNOWN}/*/{ASIDE_METADATA}")):
        return "by name", "unfinished build that a kill stopped in a move; the same command goes on"
    return "unneeded", "a build that was stopped before any row was done"


def find_named(entries: Sequence[StoreEntry], paths: Sequence[Path]) -> list[StoreEntry]:
    """The entries at these paths, which may be builds with feature rows.

    Raises `ConfigError`, with the reason, for a path that may not be removed.
    """
    known = {entry.path.absolute(): entry for entry in entries}
    for path in paths:
        entry = known.get(path.absolute())
        fate, why = fate_of(entry) if entry else ("kept", "no leftover of a build")
        if fate == "kept":
            raise ConfigError(
                f"stores.inputs: {path}: {why}. Nothing was removed; "
                f"{command('store', 'gc')} lists what may be."
            )
    return [known[path.absolute()] for path in paths]


def describe_kept(entries: Sequence[StoreEntry]) -> list[str]:
    """One line for each entry that looks like a leftover but stays, with the reason."""
    lines: list[str] = []
    for entry in entries:
        fate, why = fate_of(entry)
        if fate == "by name":
            lines.append(f"{entry.path}: {why}, and {gc_command(entry.path)} removes it")
        elif fate == "kept" and entry.kind in ("build", "previous"):
            lines.append(f"{entry.path}: {why}")
    return lines


def remove_entry(entry: StoreEntry, fate: Fate) -> bool:
    """Remove an entry if its fate is still this one; returns whether it was removed.

    Holds the lock of its store meanwhile. Raises `StoreLocked` where a build has begun since.
    """
    path, lock = entry.path, entry.base.with_name(entry.base.name + ".lock")
    had_lock = lock.exists()
    try:
        with build_lock(entry.base):
            if fate_of(entry)[0] != fate:
                return False
            if path.is_dir():
                remove_folder(path, _owner(path) or STORE)
            else:
                path.unlink(missing_ok=True)
            if not had_lock:
                lock.unlink(missing_ok=True)
            return True
    except StoreLocked as error:
        raise StoreLocked(f"{path}: not removed. {error}") from None


def _walk(folder: Path, subfolders: bool) -> Iterator[tuple[Path, str, Path]]:
    """Everything that belongs to a store, in or below a folder; does not follow links."""
    for path in sorted(folder.iterdir()):
        name = _NAME.fullmatch(path.name)
        if name and name["suffix"] in _KINDS:
            yield path, _KINDS[name["suffix"]], path.with_name(name["base"])
        elif subfolders and path.is_dir() and not path.is_symlink():
            yield from _walk(path, subfolders)


def _entry(path: Path, kind: str, base: Path) -> StoreEntry:
    lock = base.with_name(base.name + ".lock")
    holder = damage = None
    try:
        holder = lock_holder(lock) if lock.is_file() else None
    except PipelineError as error:  # a broken lock file says nothing about the other entries
        damage = str(error) if kind == "lock" else None
    entry = StoreEntry(path, kind, base, _bytes(path), damage=damage, holder=holder)
    try:
        if kind == "store" and is_archive(path):
            entry, manifest = replace(entry, kind="archive"), read_manifest(path)
            specs, rows = manifest.specs(path), manifest.specs(path)[CHECKSUMS].shape[0]
            return replace(entry, attributes=manifest.attributes(path), specs=specs, done=rows)
        if kind == "store":
            FeatureStore.open(path)
        if kind == "store" or is_store(path):
            root, specs = laid_out_attributes(path), read_specs(path)
            return replace(entry, attributes=root, specs=specs, done=_done(path))
    except PipelineError as error:  # list the others
        return replace(entry, damage=str(error))
    except OSError as error:  # removed meanwhile, or unreadable
        return replace(entry, damage=f"{path}: {error.strerror}")
    return entry


def _bytes(path: Path) -> int:
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
        yield f"damaged: {_first_clause(entry.damage)}"
    if (root := entry.attributes) and entry.kind == "store":
        streams = ("tick/action", "sensor/values", "state/values")
        action, sensor, state = (entry.specs[name].shape[1] for name in streams)
        rate = "recorded rows" if root.action_hz is None else f"{root.action_hz:g} Hz"
        yield (
            f"{root.streams.action.kind} action {action}, sensor {sensor}, state {state}; {rate}, "
            f"an answer every {root.vlm_reuse_count} ticks; sources {', '.join(root.sources)}"
        ).strip()
    if entry.holder and entry.kind != "archive":
        doing = "being built" if entry.kind == "build" else "locked"
        yield f"{doing} by {entry.holder}"


def _spec(entry: StoreEntry) -> tuple[str, str]:
    """The first digits of a feature spec's digest, and the entries that tell specs apart."""
    assert entry.attributes is not None
    features, document = entry.specs[FEATURES], entry.attributes.raw["feature_spec"]
    layers = [slot.layer for slot in entry.attributes.slots]
    named = ["the vision tower" if layer == "vision" else f"layer {layer}" for layer in layers]
    slots = [
        f"{slot.pooling} of {n}" for slot, n in zip(entry.attributes.slots, named, strict=True)
    ]
    settings = {"pooling": " + ".join(dict.fromkeys(slots))}
    settings |= {name: document[name] for name in _SPEC_ENTRIES if document.get(name)}
    return entry.attributes.feature_spec.digest[:8], ", ".join(
        [
            f"{features.shape[1]} slots x "
            f"{packed_dim(features.stored_dtype, features.shape[2])} in {features.stored_dtype}",
            f"sensor in {entry.specs['sensor/values'].dtype.name}",
            *(
                f"{name} {shorten(str(value), 60, placeholder='…')}"
                for name, value in settings.items()
            ),
        ]
    )


def _first_clause(damage: str) -> str:
    """What is wrong, without the advice after it."""
    return damage.split(". ", 1)[0].splitlines()[0]


def _is_ours(entry: StoreEntry) -> bool:
    path = entry.path
    if entry.kind == "lock":
        return path.is_file() and entry.damage is None
    if entry.kind == "ledger":  # or one of SQLite's own files beside it
        return is_ledger(path) if path.suffix == ".sqlite" else path.is_file()
    return _owner(path) is not None


def _owner(path: Path) -> OutputKind | None:
    """The kind of folder that its marker names, or a sealed build, which has lost its marker.

    None where this project did not write it.
    """
    for kind in (STORE, ARCHIVE, KEPT):
        if kind.marks(path):
            return OutputKind(kind.name)  # looks at the marker alone: metadata may be damaged
    with suppress(StoreIncomplete):
        return STORE if STORE.owns(path) else None
    return None
