"""Where a store lies, what lies beside it, and whether what lies there is one."""

from pathlib import Path
from typing import Any

from pipeline.base.border import Border, shown
from pipeline.base.durable import recover as recover_replaced
from pipeline.base.errors import StoreIncomplete, StoreMismatch
from pipeline.base.ownership import OutputKind, described, refuse_foreign, there
from pipeline.store.border import Group, StoreAttributes
from pipeline.store.repair_hints import extract_command, mend, restore_command, start_over
from pipeline.store.schema import SCHEMA

MERGED = "merge-"
"""How the plan of a store begins that was not extracted but merged."""

Inode = tuple[int, int]


def part_path(target: Path) -> Path:
    """Where a store is built."""
    return target.with_name(target.name + ".part")


def is_store(path: Path) -> bool:
    """Whether a store of this project, or a laid-out build of one, lies there."""
    attributes = group_attributes(path)
    return "schema" in attributes and bool({"plan", "feature_spec"} & attributes.keys())


STORE = OutputKind("a feature store", is_store)


def refuse_foreign_store(target: Path) -> None:
    """Raise `ConfigError` where what lies at a store's place or its build's is neither."""
    for place in (target, part_path(target)):
        refuse_foreign(place, STORE)


def recover(target: Path) -> None:
    """Undo or complete a replacement that a kill stopped, before anything is written there.

    Raises `ConfigError` where something lies there that this project did not write.
    """
    refuse_foreign_store(target)
    recover_replaced(target, STORE)


def read_plan(store: Path) -> str | None:
    """The plan of a store or a laid-out build; None where there is neither.

    Raises `StoreIncomplete` where there is one that has lost it.
    """
    plan = group_attributes(store).get("plan")
    if not isinstance(plan, str) and is_store(store):
        raise StoreIncomplete(
            f"{store / 'zarr.json'}: the metadata no longer say what the store was made of. "
            f"{start_over(store)}"
        )
    return plan if isinstance(plan, str) else None


def read_attributes(root: Path) -> StoreAttributes:
    """The root attributes of a finished store.

    Raises `StoreIncomplete` where one is missing or wrong, and what `find_attributes` does.
    """
    return StoreAttributes.of(root, find_attributes(root))


def laid_out_attributes(root: Path) -> StoreAttributes:
    """The root attributes of a store or a laid-out build, wherever it lies."""
    return StoreAttributes.of(root, group_attributes(root))


def find_attributes(root: Path) -> dict[str, Any]:
    """The root attributes of a finished store, as they stand there: they may be wrong.

    Raises `StoreIncomplete` where there is none, only a build of it, one that lost them or
    something else, and `StoreMismatch` where it follows another schema or is an archive.
    """
    build = root.name.endswith(".part")  # which looks like a store until its files are read
    attributes = {} if build else group_attributes(root)
    if "archive" in attributes:
        raise StoreMismatch(
            f"{root}: expected a store, found an archive of one. Restore it first: "
            f"{restore_command(root)}"
        )
    if "schema" not in attributes:
        part = root if build else part_path(root)
        target = root.with_name(root.name.removesuffix(".part").removesuffix(".repair"))
        found, then = "nothing there", f"Run {extract_command(target)}."
        if part.exists():
            found = f"only the unfinished build {part}"
        elif there(root):
            found = f"{described(root)} and no zarr.json that says so"
            then = f"It was left as it is: name another place, or, if it was one, {mend(root)}"
        raise StoreIncomplete(f"{root}: no finished store, found {found}. {then}")
    if attributes["schema"] != SCHEMA:
        raise StoreMismatch(
            f"{root / 'zarr.json'}: expected store schema {SCHEMA}, found "
            f"{shown(attributes['schema'])}. Extract it again with this version."
        )
    return attributes


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


def group_attributes(path: Path) -> dict[str, Any]:
    """Those of the zarr group at `path`; none where there is no group.

    Raises `StoreIncomplete` where its metadata cannot be read.
    """
    if not (path / "zarr.json").exists():
        return {}
    return Border(StoreIncomplete, start_over(path)).read_json(path / "zarr.json", Group).attributes
