"""Where a store lies, what lies beside it, and whether what lies there is one."""

import json
from pathlib import Path
from typing import Any

from pipeline.base.durable import recover as recover_replaced
from pipeline.base.errors import StoreIncomplete, StoreMismatch
from pipeline.base.ownership import OutputKind, described, refuse_foreign, there
from pipeline.store.repair_hints import extract_command, restore_command, start_over
from pipeline.store.schema import SCHEMA

MERGED = "merge-"
"""How the plan of a store begins that was not extracted but merged."""

Inode = tuple[int, int]


def part_path(target: Path) -> Path:
    """Where a store is built."""
    return target.with_name(target.name + ".part")


def is_store(path: Path) -> bool:
    """Whether a store of this project, or a laid-out build of one, lies there."""
    attributes = _attributes(path)
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
    plan = _attributes(store).get("plan")
    if not isinstance(plan, str) and is_store(store):
        raise StoreIncomplete(
            f"{store / 'zarr.json'}: the metadata no longer say what the store was made of. "
            f"{start_over(store)}"
        )
    return plan if isinstance(plan, str) else None


def read_attributes(root: Path) -> dict[str, Any]:
    """The root attributes of a finished store.

    Raises `StoreIncomplete` where there is none, only a build of it, one that lost them or
    something else, and `StoreMismatch` where it follows another schema or is an archive.
    """
    build = root.name.endswith(".part")  # which looks like a store until its files are read
    attributes = {} if build else _attributes(root)
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
            found, then = described(root), "It was left as it is: name another place."
        raise StoreIncomplete(f"{root}: no finished store, found {found}. {then}")
    if attributes["schema"] != SCHEMA:
        raise StoreMismatch(
            f"{root}: expected store schema {SCHEMA}, found {attributes['schema']!r}. "
            "Extract it again with this version."
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


def _attributes(path: Path) -> dict[str, Any]:
    """Those of the zarr group at `path`; none where there is no group."""
    try:
        document = json.loads((path / "zarr.json").read_text())
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except (json.JSONDecodeError, UnicodeDecodeError):
        raise StoreIncomplete(
            f"{path / 'zarr.json'}: not a zarr group's metadata. {start_over(path)}"
        ) from None
    attributes = document.get("attributes") if isinstance(document, dict) else None
    return attributes if isinstance(attributes, dict) else {}
