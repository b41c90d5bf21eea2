"""Housekeeping among the stores of `stores.folder`: what is there, merge, tidy up.

python -m stages.store list                             sizes, specs, who depends on what
python -m stages.store merge A.zarr B.zarr --into C.zarr
                                                        one store of several, nothing computed
python -m stages.store gc                               what nothing needs, and why
python -m stages.store gc --remove                      remove it; never a finished store, nor
                                                        what a living process is building
"""

import sys
from pathlib import Path

from pipeline.config import Params, StoresParams
from pipeline.errors import ConfigError, PipelineError, StoreLocked
from pipeline.store import FeatureStore
from pipeline.store.housekeeping import (
    Inventory,
    kept_back,
    leftovers,
    remove,
    size,
    table,
    take_inventory,
)
from pipeline.store.merging import merge
from pipeline.training.dependents import find_trained
from stages.command import Shorthand, run

SHORTHANDS = (
    Shorthand("action", "stores.action", "list, merge or gc", "ACTION", "?"),
    Shorthand("inputs", "stores.inputs", "the stores to merge", "STORE", "*"),
    Shorthand("--into", "stores.output", "the store to merge into", "STORE"),
    Shorthand("--remove", "stores.remove", "gc removes what it lists"),
)


def main(params: Params) -> None:
    """Do what `stores.action` says."""
    wanted = params.stores
    match wanted.action:
        case "list":
            _list(wanted)
        case "merge":
            _merge(wanted)
        case "gc":
            _gc(wanted)


def _list(wanted: StoresParams) -> None:
    inventory = take_inventory(wanted.folder)
    for line in table(inventory, _dependents(inventory, wanted)):
        print(line)


def _dependents(inventory: Inventory, wanted: StoresParams) -> dict[Path, list[str]]:
    """What trained policies say of each store; those that say nothing readable go to stderr."""
    trained = find_trained(wanted.checkpoints)
    for one in trained:
        if one.damage:
            print(f"not read: {one.damage}", file=sys.stderr)
    found: dict[Path, list[str]] = {}
    for entry in inventory.of_kind("store"):
        if entry.damage is None:
            store = FeatureStore.open(entry.path)
            said = ((one.folder, one.depends_on(store)) for one in trained)
            found[entry.path] = [f"{folder}: {how}" for folder, how in said if how]
    return found


def _merge(wanted: StoresParams) -> None:
    if wanted.output is None:
        raise ConfigError(
            "stores.output: expected the store to merge into, found none. Name it: "
            "python -m stages.store merge A.zarr B.zarr --into C.zarr"
        )
    report = merge(wanted.inputs, wanted.output)
    if report is not None:
        print(
            f"{report.store}: {report.episodes} episodes, {report.rows} rows, none computed; "
            f"{report.twice} episode(s) were held twice and are kept once"
        )


def _gc(wanted: StoresParams) -> None:
    inventory = take_inventory(wanted.folder)
    for line in kept_back(inventory):
        print(f"kept: {line}")
    found = leftovers(inventory)
    locked: list[PipelineError] = []
    for one in found:
        if wanted.remove:
            try:
                remove(one)
            except StoreLocked as error:
                locked.append(error)
                continue
        done = "removed" if wanted.remove else "unneeded"
        print(f"{done}: {one.path}, {size(one.bytes)}: {one.why}")
    freed = size(sum(one.bytes for one in found))
    if not found:
        print(f"{wanted.folder}: nothing to remove")
    elif not wanted.remove:
        print(f"{wanted.folder}: {freed} in {len(found)} place(s); --remove removes them")
    if locked:
        raise locked[0]


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS))
