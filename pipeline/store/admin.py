"""What lies in a folder of stores, as a table for people, and what of it nothing needs any more.

Metadata and a few small arrays are read, whatever the size. A damaged store is listed with the
reason and stops nothing. A finished store is never removed, nor anything that a living process is
building, nor what lies behind a symbolic link. An unfinished build that holds feature rows is work
that the next run resumes or takes over: it goes only where it is named.
"""

import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from textwrap import shorten
from typing import Literal

import numpy as np

from pipeline.base.digests import LEDGER_SUFFIX, is_ledger
from pipeline.base.errors import ConfigError, PipelineError, StoreIncomplete, StoreLocked
from pipeline.base.files import HELD, OutputKind, remove_folder
from pipeline.base.format import size
from pipeline.base.table import Table
from pipeline.store.archive import ARCHIVE, is_archive, read_manifest
from pipeline.store.border import StoreAttributes
from pipeline.store.chunks import read_rows
from pipeline.store.lock import build_lock, lock_holder
from pipeline.store.paths import (
    KEPT,
    MERGED,
    STORE,
    builds_aside,
    laid_out_attributes,
    read_plan,
)
from pipeline.store.reader import FeatureStore
from pipeline.store.repair_hints import gc_command
from pipeline.store.schema import CHECKSUMS, FEATURES, ArraySpec, read_specs

Fate = Literal["unneeded", "work", "kept", "in place"]
"""`work` goes where it is named; what is `kept` looks like a leftover and is none."""

_KINDS = {
    None: "store",
    ".part": "build",
    ".repair.part": "repair",
    ".known": "set aside",
    ".replaced": "replaced",
    ".keeping": "replaced",
    ".previous": "previous",
    ".lock": "lock",
    LEDGER_SUFFIX: "ledger",
}
"""What a name is that ends so after a store's; a store may turn out to be an `archive`."""
_NAME = re.compile(r"(?P<base>.+?\.zarr)(?P<suffix>\.[a-z.]+?)?(?:-(?:\d+|wal|shm))?")
_BUILDS = ("build", "set aside", "replaced", "previous")
_UNNEEDED = {
    "build": "a build that was stopped before any row was done; there is nothing to resume",
    "repair": "a repair that was stopped before it was a build; the next begins anew",
    "set aside": "an interrupted build of which no row was done",
    "replaced": "another store has taken its place",
    "ledger": "content digests for a store that is not there",
    "lock": "held by no process",
}
"""Why something of a kind may go, where it is no work and nothing holds it."""
_SHOWN = ("processor", "weights", "adapter", "compute_dtype", "variants", "prompt")
"""Entries of a feature spec that are listed."""


@dataclass(frozen=True)
class StoreContents:
    """What a store, an archive of one or a build says it holds."""

    said: StoreAttributes
    specs: Mapping[str, ArraySpec]
    done: int
    """Feature rows that are there; fewer than `rows` in a build."""

    @property
    def rows(self) -> int:
        """Feature rows."""
        return self.specs[FEATURES].shape[0]

    @property
    def digest(self) -> str:
        """The beginning of the feature spec's."""
        return self.said.feature_spec.digest[:8]


@dataclass(frozen=True)
class StoreEntry:
    """One thing in a folder of stores."""

    path: Path
    kind: str
    base: Path
    """The store that it is, or belongs to."""
    files: Mapping[tuple[int, int], int] = field(repr=False)
    """Bytes on the disk of each file, by device and inode."""
    contents: StoreContents | None
    damage: str | None
    """Why it cannot be used, if so."""

    @property
    def bytes(self) -> int:
        """On the disk."""
        return sum(self.files.values())


@dataclass(frozen=True)
class Inventory:
    """Everything in a folder that belongs to a store, by path."""

    folder: Path
    entries: tuple[StoreEntry, ...]

    @property
    def bytes(self) -> int:
        """On the disk, each hard-linked file once."""
        files = {key: size for entry in self.entries for key, size in entry.files.items()}
        return sum(files.values())

    @cached_property
    def holders(self) -> dict[Path, str]:
        """Stores that a living process is building -> that process, as its lock says."""
        locks = (entry for entry in self.entries if entry.kind == "lock")
        holders = ((lock.base, lock_holder(lock.path)) for lock in locks)
        return {base: holder for base, holder in holders if holder is not None}


@dataclass(frozen=True)
class Leftover:
    """Something in a folder of stores, and whether it may be removed."""

    entry: StoreEntry
    fate: Fate
    why: str


def take_inventory(folder: Path, *, subfolders: bool = True) -> Inventory:
    """Everything in `folder` and its subfolders that belongs to a store.

    Raises `ConfigError` where there is no such folder.
    """
    if not folder.is_dir():
        raise ConfigError(
            f"stores.folder: expected a folder of stores, found none at {folder}. Name it with "
            "--set stores.folder=…"
        )
    return Inventory(folder, tuple(_entry(*place) for place in _walk(folder, subfolders)))


def describe_inventory(inventory: Inventory, dependents: Mapping[Path, Sequence[str]]) -> list[str]:
    """Sizes and counts, a line each; below each store what depends on it, then the specs.

    `dependents`: store -> what trained policies depend on it, a line each.
    """
    shown = [entry for entry in inventory.entries if entry.kind != "lock"]
    if not shown:
        return [f"{inventory.folder}: no store in it"]
    heads = ("", "what", "on disk", "episodes", "ticks", "VL rows", "spec")
    header, *rows = Table(heads, [_row(inventory, entry) for entry in shown]).text()
    lines = [header]
    for entry, row in zip(shown, rows, strict=True):
        details = [*_details(inventory, entry), *dependents.get(entry.path, ())]
        lines += [row, *(f"    {line}" for line in details)]
    specs = {entry.contents.digest: entry.contents for entry in shown if entry.contents}
    apart, once = sum(entry.bytes for entry in inventory.entries), inventory.bytes
    linked = f", {size(apart - once)} of hard links counted once" if apart > once else ""
    return [
        *lines,
        "",
        *(f"spec {digest}: {_spec(contents)}" for digest, contents in specs.items()),
        f"{inventory.folder}: {size(once)} on the disk{linked}",
    ]


def find_leftovers(inventory: Inventory) -> list[Leftover]:
    """What nothing needs, with the reason, by path."""
    return [leftover for leftover in _judge(inventory) if leftover.fate == "unneeded"]


def find_named(inventory: Inventory, paths: Sequence[Path]) -> list[Leftover]:
    """These very leftovers, unfinished builds with their rows among them.

    Raises `ConfigError` for a path that is none, with the reason.
    """
    known = {leftover.entry.path.absolute(): leftover for leftover in _judge(inventory)}
    named = [known.get(path.absolute()) for path in paths]
    for path, leftover in zip(paths, named, strict=True):
        if leftover is None or leftover.fate in ("kept", "in place"):
            why = leftover.why if leftover else "no leftover of a build"
            raise ConfigError(
                f"stores.inputs: {path}: {why}. Nothing was removed; "
                "python -m stages.store gc lists what may be."
            )
    return [leftover for leftover in named if leftover]


def describe_kept(inventory: Inventory) -> list[str]:
    """What looks like a leftover and is none, with the reason, a line each."""
    return [
        f"{leftover.entry.path}: {leftover.why}"
        + f", and {gc_command(leftover.entry.path)} removes it" * (leftover.fate == "work")
        for leftover in _judge(inventory)
        if leftover.fate == "work" or (leftover.fate == "kept" and leftover.entry.kind != "lock")
    ]


def remove_leftover(leftover: Leftover) -> None:
    """Remove it, holding the lock of its store; nothing behind a symbolic link is touched.

    Raises `StoreLocked` where a build has begun since.
    """
    path, base = leftover.entry.path, leftover.entry.base
    lock = base.with_name(base.name + ".lock")
    there = lock.exists()
    try:
        with build_lock(base):
            # Looked at again under the lock: a killed replacement leaves the only copy there.
            held = _KINDS.get(path.suffix) == "replaced" or (path / ".replaced").exists()
            only_copy = held and not base.exists()
            if path.is_symlink() or only_copy:
                return
            if path.is_dir():
                remove_folder(path, _owner(path) or STORE)
            else:
                path.unlink(missing_ok=True)
            if not there:
                lock.unlink(missing_ok=True)
    except StoreLocked as error:
        raise StoreLocked(f"{path}: not removed. {error}") from None


def _walk(folder: Path, subfolders: bool) -> Iterator[tuple[Path, str, Path]]:
    """What belongs to a store, at or below a folder; links to folders are not followed."""
    for path in sorted(folder.iterdir()):
        name = _NAME.fullmatch(path.name)
        if name and name["suffix"] in _KINDS:
            yield path, _KINDS[name["suffix"]], path.with_name(name["base"])
        elif subfolders and path.is_dir() and not path.is_symlink():
            yield from _walk(path, subfolders)


def _entry(path: Path, kind: str, base: Path) -> StoreEntry:
    contents, damage = None, None
    try:
        if kind == "store" and is_archive(path):
            kind = "archive"
        elif kind == "store":
            FeatureStore.open(path)
        if kind in ("store", "archive") or (kind in _BUILDS and read_plan(path) is not None):
            contents = _contents(path, kind)
    except PipelineError as error:  # the others are listed
        damage = str(error)
    except OSError as error:  # removed meanwhile, or not to be read
        damage = f"{path}: {error.strerror}"
    return StoreEntry(path, kind, base, _files(path), contents, damage)


def _contents(path: Path, kind: str) -> StoreContents:
    if kind == "archive":
        manifest = read_manifest(path)
        specs = manifest.specs(path)
        return StoreContents(manifest.said(path), specs, specs[CHECKSUMS].shape[0])
    specs = read_specs(path)
    done = np.count_nonzero(read_rows(path, specs[CHECKSUMS]))
    return StoreContents(laid_out_attributes(path), specs, int(done))


def _files(path: Path) -> dict[tuple[int, int], int]:
    """Bytes on the disk of each file, by device and inode."""
    files: dict[tuple[int, int], int] = {}
    for file in path.rglob("*") if path.is_dir() else [path]:
        with suppress(OSError):  # removed meanwhile, or a link into an emptied cache
            status = file.stat()  # of the file itself where a cache hands out symbolic links
            if not stat.S_ISDIR(status.st_mode):
                files[status.st_dev, status.st_ino] = status.st_blocks * 512
    return files


def _row(inventory: Inventory, entry: StoreEntry) -> tuple[object, ...]:
    name = entry.path.relative_to(inventory.folder).as_posix()
    row = (name, "damaged" if entry.damage else entry.kind, size(entry.bytes))
    held = entry.contents
    if held is None:
        return (*row, None, None, None, None)
    rows = held.rows if held.done == held.rows else f"{held.done:,} of {held.rows:,}"
    counts = (held.specs[array].shape[0] for array in ("episode/source", "tick/time"))
    return (*row, *counts, rows, held.digest)


def _details(inventory: Inventory, entry: StoreEntry) -> Iterator[str]:
    if entry.damage:
        yield f"damaged: {_clause(entry.damage)}"
    if entry.contents is not None and entry.kind == "store":
        yield _embodiment(entry.contents)
    holder = inventory.holders.get(entry.base)
    if holder and entry.kind != "archive":
        yield f"being built by {holder}" if entry.kind == "build" else f"locked by {holder}"


def _embodiment(held: StoreContents) -> str:
    said, streams = held.said, ("tick/action", "sensor/values", "state/values")
    action, sensor, state = (held.specs[name].shape[1] for name in streams)
    rate = "recorded rows" if said.action_hz is None else f"{said.action_hz:g} Hz"
    return (
        f"{said.streams.action.kind} action {action}, sensor {sensor}, state {state}; {rate}, an "
        f"answer every {said.vlm_reuse_count} ticks; sources {', '.join(said.sources)}"
    ).strip()


def _spec(held: StoreContents) -> str:
    """The main entries of a feature spec: what tells two specs apart at a glance."""
    spec, features = held.said.feature_spec, held.specs[FEATURES]
    document = held.said.raw["feature_spec"]
    slots = [f"{slot.pooling} of layer {slot.layer}" for slot in spec.slots]
    named = [
        ("pooling", " + ".join(dict.fromkeys(slots))),
        *((name, document.get(name)) for name in _SHOWN),
    ]
    _, count, dim = features.shape
    return ", ".join(
        [
            f"{count} slots x {dim} in {features.stored_dtype}",
            f"sensor in {held.specs['sensor/values'].dtype.name}",
            *(f"{name} {shorten(str(it), 60, placeholder='…')}" for name, it in named if it),
        ]
    )


def _clause(damage: str) -> str:
    """What is wrong, without what to run about it."""
    return damage.split(". ", 1)[0].splitlines()[0]


def _judge(inventory: Inventory) -> Iterator[Leftover]:
    """What may become of each entry, by path."""
    for entry in inventory.entries:
        yield Leftover(entry, *_fate(inventory, entry))


def _fate(inventory: Inventory, entry: StoreEntry) -> tuple[Fate, str]:
    """Whether it may be removed, and why, or why not."""
    if entry.kind in ("store", "archive"):
        return "in place", f"a finished {entry.kind}, which is never removed here"
    if entry.path.is_symlink():
        return "kept", "a symbolic link, left alone"
    is_file = entry.path.name.endswith(LEDGER_SUFFIX)
    if not (is_ledger(entry.path) if is_file else entry.path.is_file() or _owner(entry.path)):
        return "kept", "this project did not write it, left alone"
    if holder := inventory.holders.get(entry.base):
        return "kept", f"in use by {holder}"
    if entry.kind == "previous":
        return "work", "the store of before, kept until the next successful stages.extract"
    if entry.kind in ("build", "set aside") and (work := _work(entry)):
        return "work", f"unfinished build{work}"
    beside = [other for other in inventory.entries if other.base == entry.base]
    sound = {other.kind for other in beside if other.damage is None}
    if entry.kind == "replaced" and not sound & {"store", "archive"}:
        return "kept", (
            f"the only copy of {entry.base.name}, set aside by a replacement that was killed; the "
            "next stages.extract puts it back"
        )
    if entry.kind == "ledger" and any(other.kind not in ("lock", "ledger") for other in beside):
        return "in place", "content digests for a store that is there"
    return "unneeded", _UNNEEDED[entry.kind]


def _work(entry: StoreEntry) -> str | None:
    """What would be lost with an unfinished build; None where that holds no row."""
    if entry.damage is not None:
        return f" that cannot be read: {_clause(entry.damage)}"
    if entry.kind == "build" and (aside := builds_aside(entry.base)):
        return f" with the rows of {len(aside)} other(s) in it; stages.extract takes them over"
    held = entry.contents
    if held is None or not held.done:
        return None
    merged = held.said.plan.startswith(MERGED)
    command = "the same stages.store merge" if merged else "stages.extract"
    return f", {held.done} of {held.rows} rows done; {command} takes them over"


def _owner(path: Path) -> OutputKind | None:
    """The kind that a folder is of, None where it is not ours.

    The marker decides: removed as another kind and killed meanwhile, it would be foreign to the
    command that looks for its own kind there.
    """
    kinds = (STORE, ARCHIVE, KEPT, HELD)
    try:
        marked = next((kind for kind in kinds if kind.marks(path)), None)
        return marked or next((kind for kind in kinds if kind.owns(path)), None)
    except StoreIncomplete:  # a group's metadata, but damaged
        return OutputKind(STORE.name, lambda _: True)
