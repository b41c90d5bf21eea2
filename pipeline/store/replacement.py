"""One store takes the place of another: whole, and seen by those who were reading."""

import shutil
from pathlib import Path

from pipeline.durable import sync
from pipeline.errors import StoreMismatch

Inode = tuple[int, int]


def put_in_place(part: Path, target: Path) -> None:
    """Rename a complete store to `target`; what was there is removed.

    A kill leaves the old store or the new, for one instant under the name `<target>.old`, from
    where `recover` brings it back.
    """
    old = _old_path(target)
    if target.exists():
        _discard(old)
        target.rename(old)
    part.rename(target)
    sync(target.parent)
    _discard(old)


def recover(target: Path) -> None:
    """Mend what a kill between the two renames of a replacement left behind."""
    old = _old_path(target)
    if target.exists():
        _discard(old)
    elif old.exists():
        old.rename(target)


def inode_of(store: Path) -> Inode | None:
    """Tells a store from another that took its place; None where there is none."""
    try:
        status = store.stat()
    except FileNotFoundError:
        return None
    return status.st_dev, status.st_ino


def refuse_replaced(store: Path, before: Inode | None) -> None:
    """Raise `StoreMismatch` where a store is no longer the one that it was `before`.

    A finished store is never modified, but an extraction may put another in its place.
    """
    if inode_of(store) != before:
        raise StoreMismatch(
            f"{store}: another store took its place while it was being read. Run the same command "
            "again."
        )


def _discard(old: Path) -> None:
    """Remove a store that was replaced; of one behind a symbolic link, the link alone."""
    if old.is_symlink():
        old.unlink()
    elif old.exists():
        shutil.rmtree(old)


def _old_path(target: Path) -> Path:
    return target.with_name(target.name + ".old")
