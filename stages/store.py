"""List, merge or tidy up the stores of `stores.folder`.

  python -m stages.store list                           sizes, specs, who depends on what
  python -m stages.store merge A.zarr B.zarr --into C.zarr
                                                        one store of several, nothing computed
  python -m stages.store gc                             what stopped builds left
  python -m stages.store gc --remove                    remove the builds that hold no rows
  python -m stages.store gc A.zarr.part --remove        remove that build, or A.zarr.previous, with
                                                        its rows; never a finished store

list and gc without --remove write nothing. Next after a merge: python -m stages.verify
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from stages.command import Shorthand, run

if TYPE_CHECKING:
    from pipeline.base.config import Params, StoresParams
    from pipeline.store.inventory import StoreEntry

SECTIONS = ("stores",)
SHORTHANDS = (
    Shorthand("action", "stores.action", "list, merge or gc", "ACTION", "?"),
    Shorthand(
        "inputs",
        "stores.inputs",
        "the stores to merge; the builds that gc removes",
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
    from pipeline.base.text import size
    from pipeline.store.documents import gc_command
    from pipeline.store.inventory import is_unneeded, leftover, list_stores, remove_leftover

    leftovers = [leftover(path) for path in params.inputs]
    if not params.inputs:
        for entry in list_stores(params.folder):
            if entry.kind not in ("build", "previous"):
                continue
            if is_unneeded(entry):
                leftovers.append(entry)
            else:
                why = entry.damage or f"{entry.done} feature rows"
                print(f"kept: {entry.path}: {why}; {gc_command(entry.path)} removes it")
    for entry in leftovers:
        if params.remove:
            remove_leftover(entry)
        what = "removed" if params.remove else "unneeded"
        print(f"{what}: {entry.path}, {size(entry.bytes)}, {entry.done} feature rows")
    if not leftovers:
        print(f"{params.folder}: nothing to remove")
    elif not params.remove:
        print("--remove removes what is unneeded")


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))
