"""Housekeeping among the stores of `stores.folder`: what is there, merge, tidy up.

  python -m stages.store list                           sizes, specs, who depends on what
  python -m stages.store merge A.zarr B.zarr --into C.zarr
                                                        one store of several, nothing computed
  python -m stages.store gc                             what nothing needs, and why
  python -m stages.store gc --remove                    remove it; never a finished store, nor
                                                        what a living process is building, nor an
                                                        unfinished build that holds rows
  python -m stages.store gc A.zarr.part --remove        remove that one, its rows too

list and gc without --remove write nothing. Next after a merge: python -m stages.verify
"""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from stages.command import Shorthand, run

if TYPE_CHECKING:
    from pipeline.base.config import Params, StoresParams
    from pipeline.base.errors import PipelineError
    from pipeline.store.admin import Inventory, Leftover

SECTIONS = ("stores",)
SHORTHANDS = (
    Shorthand("action", "stores.action", "list, merge or gc", "ACTION", "?"),
    Shorthand(
        "inputs",
        "stores.inputs",
        "the stores to merge; the unfinished builds that gc removes",
        "STORE",
        "*",
    ),
    Shorthand("--into", "stores.output", "the store to merge into", "STORE"),
    Shorthand("--remove", "stores.remove", "gc removes what it lists"),
)


def main(params: "Params") -> None:
    """Do what `stores.action` says."""
    match params.stores.action:
        case "list":
            _list(params.stores)
        case "merge":
            _merge(params.stores)
        case "gc":
            _gc(params.stores)


def _list(params: "StoresParams") -> None:
    from pipeline.base.errors import ConfigError
    from pipeline.store.admin import describe_inventory, take_inventory

    if params.inputs:
        raise ConfigError(
            f"stores.inputs: list takes no paths, found {', '.join(map(str, params.inputs))}. It "
            "lists all of stores.folder: name another with --set stores.folder=…"
        )
    inventory = take_inventory(params.folder)
    print(*describe_inventory(inventory, _dependents(inventory, params)), sep="\n")


def _dependents(inventory: "Inventory", params: "StoresParams") -> dict[Path, list[str]]:
    """What trained policies say of each store; those that say nothing readable go to stderr."""
    from pipeline.store import FeatureStore
    from pipeline.train.run import find_trained

    trained = find_trained(params.checkpoints)
    for policy in trained:
        if policy.damage:
            print(f"not read: {policy.damage}", file=sys.stderr)
    dependents: dict[Path, list[str]] = {}
    for entry in inventory.entries:
        if entry.kind == "store" and entry.damage is None:
            store = FeatureStore.open(entry.path)
            depends = ((policy.folder, policy.depends_on(store)) for policy in trained)
            dependents[entry.path] = [f"{folder}: {how}" for folder, how in depends if how]
    return dependents


def _merge(params: "StoresParams") -> None:
    from pipeline.store.merging import merge

    merged = merge(params.inputs, params.output)
    if merged is not None:
        print(
            f"{params.output}: {len(merged.episodes)} episodes, {merged.count('vl')} rows, none "
            f"computed; {merged.twice} episode(s) were held twice and are kept once"
        )


def _gc(params: "StoresParams") -> None:
    from pipeline.base.errors import StoreLocked
    from pipeline.base.format import size
    from pipeline.store.admin import remove_leftover

    leftovers = _selected(params) if params.inputs else _unneeded(params)
    done: list[Leftover] = []
    locked: list[PipelineError] = []
    for leftover in leftovers:
        try:
            if params.remove:
                remove_leftover(leftover)
            done.append(leftover)
        except StoreLocked as error:
            locked.append(error)
    word = "removed" if params.remove else "unneeded"
    for leftover in done:
        print(f"{word}: {leftover.entry.path}, {size(leftover.entry.bytes)}: {leftover.why}")
    if not leftovers:
        print(f"{params.folder}: nothing to remove")
    elif not params.remove:
        freed = size(sum(leftover.entry.bytes for leftover in leftovers))
        print(f"{freed} in {len(leftovers)} place(s); --remove removes them")
    if locked:
        raise locked[0]


def _unneeded(params: "StoresParams") -> "list[Leftover]":
    from pipeline.store.admin import describe_kept, find_leftovers, take_inventory

    inventory = take_inventory(params.folder)
    for line in describe_kept(inventory):
        print(f"kept: {line}")
    return find_leftovers(inventory)


def _selected(params: "StoresParams") -> "list[Leftover]":
    """What is named, wherever it lies; only what lies beside it is looked at."""
    from pipeline.store.admin import find_named, take_inventory

    by_folder: dict[Path, list[Path]] = {}
    for path in params.inputs:
        by_folder.setdefault(path.parent, []).append(path)
    return [
        leftover
        for folder, paths in by_folder.items()
        for leftover in find_named(take_inventory(folder, subfolders=False), paths)
    ]


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))
