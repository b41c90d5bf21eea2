"""List, merge or tidy up the stores of `stores.folder`.

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
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from stages.command import Shorthand, run

if TYPE_CHECKING:
    from pipeline.base.config import Params, StoresParams
    from pipeline.base.errors import PipelineError
    from pipeline.store.inventory import StoreEntry

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
    from pipeline.store.inventory import describe_stores, list_stores

    if params.inputs:
        raise ConfigError(
            f"stores.inputs: list takes no paths, found {', '.join(map(str, params.inputs))}. It "
            "lists all of stores.folder: name another with --set stores.folder=…"
        )
    entries = list_stores(params.folder)
    print(*describe_stores(params.folder, entries, _dependents(entries, params)), sep="\n")


def _dependents(entries: "Sequence[StoreEntry]", params: "StoresParams") -> dict[Path, list[str]]:
    """The trained policies that depend on each store; those that cannot be read go to stderr."""
    from pipeline.store import FeatureStore
    from pipeline.train.run import find_trained

    trained = find_trained(params.checkpoints)
    for policy in trained:
        if policy.damage:
            print(f"not read: {policy.damage}", file=sys.stderr)
    dependents: dict[Path, list[str]] = {}
    for entry in entries:
        if entry.kind == "store" and entry.damage is None:
            store = FeatureStore.open(entry.path)
            fitting = (policy.folder for policy in trained if policy.fits(store))
            dependents[entry.path] = [f"{folder}: can be evaluated on it" for folder in fitting]
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
    from pipeline.base.text import size
    from pipeline.store.inventory import (
        describe_kept,
        fate_of,
        find_named,
        list_stores,
        remove_entry,
    )

    if params.inputs:
        folders = dict.fromkeys(path.parent for path in params.inputs)
        entries = [entry for at in folders for entry in list_stores(at, subfolders=False)]
        leftovers = find_named(entries, params.inputs)
    else:
        entries = list_stores(params.folder)
        leftovers = [entry for entry in entries if fate_of(entry)[0] == "unneeded"]
        for line in describe_kept(entries):
            print(f"kept: {line}")
    locked: list[PipelineError] = []
    for entry in leftovers:
        word, (fate, why) = "removed" if params.remove else "unneeded", fate_of(entry)
        try:
            if params.remove and not remove_entry(entry, fate):
                continue
            print(f"{word}: {entry.path}, {size(entry.bytes)}: {why}")
        except StoreLocked as error:
            locked.append(error)
    if not leftovers:
        print(f"{params.folder}: nothing to remove")
    elif not params.remove:
        freed = size(sum(entry.bytes for entry in leftovers))
        print(f"{freed} in {len(leftovers)} place(s); --remove removes them")
    if locked:
        raise locked[0]


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))
