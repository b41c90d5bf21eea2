"""What in a folder of stores nothing needs any more, and its removal.

A finished store is never among it, nor anything that a living process is building, nor what lies
behind a symbolic link. An unfinished build that holds feature rows is work that the next run
resumes or takes over: it goes only where it is named.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.digests import is_ledger
from pipeline.base.durable import HELD, KEPT
from pipeline.base.errors import ConfigError, StoreIncomplete, StoreLocked
from pipeline.base.ownership import OutputKind, remove_folder
from pipeline.store.archive.manifest import ARCHIVE
from pipeline.store.housekeeping.inventory import Entry, Inventory, Kind
from pipeline.store.housekeeping.listing import clause
from pipeline.store.lock import build_lock
from pipeline.store.paths import MERGED, STORE
from pipeline.store.repair_hints import gc_command

_REMOVABLE: tuple[Kind, ...] = (
    "build",
    "repair",
    "set aside",
    "replaced",
    "previous",
    "ledger",
    "lock",
    "unknown",
)


_KINDS = (STORE, ARCHIVE, KEPT, HELD)
_SIGNS = (OutputKind.marks, OutputKind.owns)


def _owner(path: Path) -> OutputKind | None:
    """The kind that a folder is of, None where it is not ours.

    The marker decides: removed as another kind and killed meanwhile, it would be foreign to the
    command that looks for its own kind there.
    """
    try:
        return next((kind for owns in _SIGNS for kind in _KINDS if owns(kind, path)), None)
    except StoreIncomplete:  # a group's metadata, but damaged
        return OutputKind(STORE.name, lambda _: True)


@dataclass(frozen=True)
class Leftover:
    """Something that may be removed."""

    path: Path
    base: Path
    """The store whose lock has to be held meanwhile."""
    bytes: int
    """On the disk; what hard links elsewhere hold on to is not counted."""
    why: str
    idle_lock: bool = False
    """An empty lock file, of which there may be many."""


def leftovers(inventory: Inventory) -> list[Leftover]:
    """What nothing needs, with the reason, by path."""
    return [
        _leftover(inventory, one, why)
        for one in inventory.of_kind(*_REMOVABLE)
        if _untouched(inventory, one) and _work(one) is None
        if (why := _why(inventory, one)) is not None
    ]


def named(inventory: Inventory, paths: Sequence[Path]) -> list[Leftover]:
    """These very leftovers, unfinished builds with their rows among them.

    Raises `ConfigError` for a path that is none, with the reason.
    """
    known = {one.path.absolute(): one for one in inventory.entries}
    kept = [line for one in inventory.entries for line in _in_use(inventory, one)]
    found: list[Leftover] = []
    for path in paths:
        entry = known.get(path.absolute())
        why = entry and entry.kind in _REMOVABLE and (_work(entry) or _why(inventory, entry))
        if entry is None or not why or not _untouched(inventory, entry):
            said = next((line for line in kept if line.startswith(f"{path}: ")), None)
            raise ConfigError(
                f"stores.inputs: {said or f'{path}: no leftover of a build'}. Nothing was removed; "
                "python -m stages.store gc lists what may be."
            )
        found.append(_leftover(inventory, entry, why))
    return found


def kept_back(inventory: Inventory) -> list[str]:
    """What looks like a leftover and is none, with the reason, a line each."""
    return list(_kept_back(inventory))


def remove(leftover: Leftover) -> None:
    """Remove it, holding the lock of its store; nothing behind a symbolic link is touched.

    Raises `StoreLocked` where a build has begun since.
    """
    lock = leftover.base.with_name(leftover.base.name + ".lock")
    there = lock.exists()
    try:
        with build_lock(leftover.base):
            # Looked at again under the lock: a killed replacement leaves the only copy as `.old`.
            held = leftover.path.suffix in (".old", ".replaced", ".keeping")
            only_copy = held and not leftover.base.exists()
            if leftover.path.is_symlink() or only_copy:
                return
            if leftover.path.is_dir():
                remove_folder(leftover.path, _owner(leftover.path) or STORE)
            else:
                leftover.path.unlink(missing_ok=True)
            if not there:
                lock.unlink(missing_ok=True)
    except StoreLocked as error:
        raise StoreLocked(f"{leftover.path}: not removed. {error}") from None


def _why(inventory: Inventory, entry: Entry) -> str | None:
    belongs = {
        one.kind
        for one in inventory.entries
        if one.base == entry.base and one.kind not in ("lock", "ledger")
    }
    match entry.kind:
        case "build":
            return "a build that was stopped before any row was done; there is nothing to resume"
        case "repair":
            return "a repair that was stopped before it was a build; the next begins anew"
        case "set aside":
            return "an interrupted build of which no row was done"
        case "replaced":
            there = any(
                one.base == entry.base and one.kind in ("store", "archive") and one.damage is None
                for one in inventory.entries
            )
            return f"{entry.base.name} has taken its place" if there else None
        case "ledger":
            return None if belongs else "content digests for a store that is not there"
        case "lock":
            return "held by no process"
        case _:
            return "of a write that was killed"


def _untouched(inventory: Inventory, entry: Entry) -> bool:
    """Whether no living process builds there, and it is no symbolic link and of this project."""
    if entry.path.is_symlink() or _is_foreign(entry):
        return False
    return entry.base not in inventory.holders


def _is_foreign(entry: Entry) -> bool:
    if entry.path.name.endswith(".files.sqlite"):
        return not is_ledger(entry.path)
    return entry.path.is_dir() and _owner(entry.path) is None


def _work(entry: Entry) -> str | None:
    """What would be lost with what may be removed; None where that holds no row."""
    if entry.kind == "previous":
        return "the store of before, kept for its rows until the next successful stages.extract"
    if entry.kind not in ("build", "set aside"):
        return None
    if entry.damage is not None:
        return f"unfinished build that cannot be read: {clause(entry.damage)}"
    if entry.contents is None or not entry.contents.done:
        return None
    merged = (entry.contents.plan or "").startswith(MERGED)
    goes_on = "the same stages.store merge resumes" if merged else "stages.extract resumes"
    if entry.kind == "set aside":
        goes_on = "stages.extract takes rows from"
    rows = f"{entry.contents.done} of {entry.contents.rows} rows done"
    return f"unfinished build, {rows}; {goes_on} it"


def _kept_back(inventory: Inventory) -> Iterator[str]:
    for one in inventory.entries:
        if one.kind in ("store", "archive", "lock"):
            continue
        if (lines := list(_in_use(inventory, one))) or (work := _work(one)) is None:
            yield from lines
        else:
            yield f"{one.path}: {work}, and {gc_command(one.path)} removes it"


def _in_use(inventory: Inventory, entry: Entry) -> Iterator[str]:
    """Why it may not go even where it is named."""
    if entry.kind in ("store", "archive"):
        yield f"{entry.path}: a finished {entry.kind}, which is never removed here"
    elif entry.path.is_symlink():
        yield f"{entry.path}: a symbolic link, left alone"
    elif _is_foreign(entry):
        yield f"{entry.path}: this project did not write it, left alone"
    elif entry.base in inventory.holders:
        yield f"{entry.path}: in use by {inventory.holders[entry.base]}"
    elif entry.kind == "replaced" and _why(inventory, entry) is None:
        yield (
            f"{entry.path}: the only copy of {entry.base.name}, set aside by a replacement that "
            "was killed; the next stages.extract puts it back"
        )


def _leftover(inventory: Inventory, entry: Entry, why: str) -> Leftover:
    freed = entry.bytes - sum(inventory.siblings(entry).values())
    idle_lock = entry.kind == "lock" and not entry.bytes
    return Leftover(entry.path, entry.base, freed, why, idle_lock)
