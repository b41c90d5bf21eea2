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

from stages.command import Shorthand, run

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

if __name__ == "__main__":  # here, for --help waits for no import below
    raise SystemExit(
        run(__doc__ or "", "stages.store", shorthands=SHORTHANDS, sections=("stores",))
    )

import sys
from pathlib import Path

from pipeline.base.config import Params, StoresParams
from pipeline.base.errors import ConfigError, PipelineError, StoreLocked
from pipeline.base.format import size
from pipeline.store import FeatureStore
from pipeline.store.housekeeping import (
    Inventory,
    Leftover,
    kept_back,
    leftovers,
    named,
    remove,
    table,
    take_inventory,
)
from pipeline.store.merging import merge
from pipeline.train.run import find_trained


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
    if wanted.inputs:
        raise ConfigError(
            f"stores.inputs: list takes no paths, found {', '.join(map(str, wanted.inputs))}. It "
            "lists all of stores.folder: name another with --set stores.folder=…"
        )
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
    report = merge([_input(path, wanted.folder) for path in wanted.inputs], wanted.output)
    if report is not None:
        print(
            f"{report.store}: {report.episodes} episodes, {report.rows} rows, none computed; "
            f"{report.twice} episode(s) were held twice and are kept once"
        )


def _input(path: Path, folder: Path) -> Path:
    """A store as it is named, or the one of that name in `stores.folder`."""
    inside = folder / path
    if path.exists() or not inside.exists():
        return path
    print(f"{path}: taking {inside}")
    return inside


def _gc(wanted: StoresParams) -> None:
    found = _selected(wanted) if wanted.inputs else _unneeded(wanted)
    done: list[Leftover] = []
    locked: list[PipelineError] = []
    for one in found:
        try:
            if wanted.remove:
                remove(one)
            done.append(one)
        except StoreLocked as error:
            locked.append(error)
    word = "removed" if wanted.remove else "unneeded"
    for one in done:
        if not one.idle_lock:
            print(f"{word}: {one.path}, {size(one.bytes)}: {one.why}")
    if idle := sum(one.idle_lock for one in done):
        print(f"{word}: {idle} empty lock file(s), held by no process")
    if not found:
        print(f"{wanted.folder}: nothing to remove")
    elif not wanted.remove:
        freed = size(sum(one.bytes for one in found))
        print(f"{freed} in {len(found)} place(s); --remove removes them")
    if locked:
        raise locked[0]


def _unneeded(wanted: StoresParams) -> list[Leftover]:
    inventory = take_inventory(wanted.folder)
    for line in kept_back(inventory):
        print(f"kept: {line}")
    return leftovers(inventory)


def _selected(wanted: StoresParams) -> list[Leftover]:
    """What is named, wherever it lies; only what lies beside it is looked at."""
    by_folder: dict[Path, list[Path]] = {}
    for path in wanted.inputs:
        by_folder.setdefault(path.parent, []).append(path)
    return [
        one
        for folder, paths in by_folder.items()
        for one in named(take_inventory(folder, subfolders=False), paths)
    ]
