"""What in a folder of stores nothing needs any more, and its removal.

A finished store is never among it, nor anything that a living process is building, nor what lies
behind a symbolic link.
"""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import StoreLocked
from pipeline.store.housekeeping.inventory import Entry, Inventory
from pipeline.store.lock import build_lock


@dataclass(frozen=True)
class Leftover:
    """Something that may be removed."""

    path: Path
    base: Path
    """The store whose lock has to be held meanwhile."""
    bytes: int
    """On the disk; what hard links elsewhere hold on to is not counted."""
    why: str


def leftovers(inventory: Inventory) -> list[Leftover]:
    """What may be removed, with the reason, by path."""
    kinds = ("build", "repair", "set aside", "replaced", "ledger", "lock", "unknown")
    return [
        Leftover(one.path, one.base, _freed(inventory, one), why)
        for one in inventory.of_kind(*kinds)
        if one.base not in inventory.holders and not one.path.is_symlink()
        if (why := _why(inventory, one)) is not None
    ]


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
            only_copy = leftover.path.suffix == ".old" and not leftover.base.exists()
            if leftover.path.is_symlink() or only_copy:
                return
            if leftover.path.is_dir():
                shutil.rmtree(leftover.path)
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
            return _why_build(entry)
        case "repair":
            return "a repair that was stopped before it was a build; the next begins anew"
        case "set aside":
            rows = f"{entry.contents.done} feature rows" if entry.contents else "rows"
            return f"{rows} of an interrupted build, which the next stages.extract takes over"
        case "replaced":
            there = "store" in belongs or "archive" in belongs
            return f"{entry.base.name} has taken its place" if there else None
        case "ledger":
            return None if belongs else "content digests for a store that is not there"
        case "lock":
            return "held by no process"
        case _:
            return "of a write that was killed"


def _why_build(entry: Entry) -> str:
    if entry.damage is not None:
        return f"an unfinished build that cannot be resumed: {entry.damage}"
    if entry.contents is None:
        return "a build that was stopped before it was laid out; there is nothing to resume"
    done, rows = entry.contents.done, entry.contents.rows
    merged = (entry.contents.plan or "").startswith("merge-")
    resumes = "the same `stages.store merge`" if merged else "stages.extract"
    return f"an unfinished build, {done} of {rows} rows done; {resumes} would resume it"


def _kept_back(inventory: Inventory) -> Iterator[str]:
    for one in inventory.entries:
        if one.kind in ("store", "archive", "lock"):
            continue
        if one.path.is_symlink():
            yield f"{one.path}: a symbolic link, left alone"
        elif one.base in inventory.holders:
            yield f"{one.path}: in use by {inventory.holders[one.base]}"
        elif one.kind == "replaced" and _why(inventory, one) is None:
            yield (
                f"{one.path}: the only copy of {one.base.name}, set aside by a replacement that "
                "was killed; the next stages.extract puts it back"
            )


def _freed(inventory: Inventory, entry: Entry) -> int:
    return entry.bytes - sum(inventory.siblings(entry).values())
