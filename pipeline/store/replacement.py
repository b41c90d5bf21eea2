"""One store takes the place of another, and those who were reading see it."""

from pathlib import Path

from pipeline.base.errors import StoreMismatch

Inode = tuple[int, int]


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
