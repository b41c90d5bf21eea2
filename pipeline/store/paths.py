"""Where a store lies and where it is built, and whether what lies there is one."""

import json
from pathlib import Path
from typing import Any

from pipeline.base.durable import recover as recover_replaced
from pipeline.base.errors import StoreIncomplete
from pipeline.base.ownership import OutputKind, refuse_foreign
from pipeline.store.repair_hints import start_over

MERGED = "merge-"
"""How the plan of a store begins that was not extracted but merged."""
LEDGER = ".files.sqlite"
"""What is added to a store's name for the file that remembers the digests of recordings."""


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
