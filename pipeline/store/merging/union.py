"""Several finished stores of one feature spec and one embodiment become one.

The merged store is a build like any other: laid out first, then filled with feature rows and their
keys, resumed after a kill, sealed at last. Nothing is computed. Its plan is its own, for it cannot
know the params that would describe all its recordings: `stages.extract` over the union of the
sources lays it out anew, and takes every row from it by key without loading the model. The repair
of a merged store is completed by merging the same stores again.
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from tqdm import tqdm

from pipeline.base.durable import free_bytes
from pipeline.base.errors import ConfigError, DiskFull, StoreIncomplete, StoreMismatch
from pipeline.base.format import size
from pipeline.store.integrity import verify
from pipeline.store.lock import build_lock
from pipeline.store.merging.copying import axis_kind, copy_features, copy_stream
from pipeline.store.merging.joining import Joined, join
from pipeline.store.metadata import ATTRIBUTE, check_metadata
from pipeline.store.paths import (
    MERGED,
    Inode,
    inode_of,
    part_path,
    read_plan,
    recover,
    refuse_replaced,
)
from pipeline.store.reader import FeatureStore
from pipeline.store.repair_hints import gc_command
from pipeline.store.schema import (
    FEATURES,
    INCREMENTAL,
    ArraySpec,
    Sizes,
    arrays,
    read_specs,
)
from pipeline.store.writer import StoreBuild

Say = Callable[[str], None]
_THREADS = 4
"""That check an input."""


@dataclass(frozen=True)
class MergeReport:
    """What was done."""

    store: Path
    episodes: int
    twice: int
    """Episodes that an earlier input holds just so."""
    rows: int


def merge(inputs: Sequence[Path], output: Path, say: Say = print) -> MergeReport | None:
    """Make `output` of the episodes of all inputs, in their order; None where it is that already.

    An episode that several hold (equal digest) is taken once, from the first. Memory stays bounded;
    every feature row has to match its checksum. The inputs are only read.

    Raises `ConfigError` for paths that cannot be merged, `StoreMismatch` where specs or embodiments
    differ or `output` holds something else, `StoreIncomplete` where an input is damaged,
    `StoreLocked` and `DiskFull`.
    """
    _check_paths(inputs, output)
    with build_lock(output):
        recover(output)
        inodes = [inode_of(path) for path in inputs]
        joined = join([FeatureStore.open(path) for path in inputs])
        for line in joined.notes:
            say(line)
        plan = _plan(joined)
        part = read_plan(part_path(output))
        if read_plan(output) == plan and part != plan:  # else a repair of it has begun
            FeatureStore.open(output)  # refuses a store that files are missing from
            check_metadata(output)
            say(f"{output}: up to date, nothing to do")
            return None
        _check_free(output, plan)
        for store in joined.stores:
            _check_sound(store.path)
        build = StoreBuild(output, _arrays(joined), plan)
        with closing(build):
            if read_plan(build.part) == plan and build.layout_damage() is None:
                say(f"continuing the interrupted build {build.part}")
            else:
                _lay_out(build, joined, inodes)
            _fill(build, joined)
            build.seal()
        rows = joined.edges["vl"][-1]
        return MergeReport(output, len(joined.episodes), joined.twice, int(rows))


def _check_paths(inputs: Sequence[Path], output: Path) -> None:
    places = [path.resolve() for path in inputs]
    if len(places) < 2:
        raise ConfigError(
            f"stores.inputs: expected two or more stores to merge, found {len(places)}. "
            "Name them: python -m stages.store merge A.zarr B.zarr --into C.zarr"
        )
    twice = sorted({str(path) for path in places if places.count(path) > 1})
    if twice:
        raise ConfigError(
            f"stores.inputs: {', '.join(twice)} is named more than once. Name it once."
        )
    if output.suffix != ".zarr" or output.resolve() in places:
        raise ConfigError(
            f"stores.output: expected a new store whose name ends in .zarr, found {output}. "
            "A finished store is never modified: choose another name for the merged one."
        )


def _check_free(output: Path, plan: str) -> None:
    """Refuse where something else stands, or is being built, in the place of the output."""
    if output.exists() and read_plan(output) != plan:
        raise StoreMismatch(
            f"{output}: expected nothing there, or these very stores merged; found another store. "
            "Choose another name with --into, or remove it first."
        )
    part = part_path(output)
    if read_plan(part) not in (None, plan):
        raise StoreMismatch(
            f"{part}: expected nothing there, or an interrupted merge of these stores; found an "
            "unfinished build of something else. Choose another name with --into, or remove it: "
            f"{gc_command(part)}"
        )


def _check_sound(path: Path) -> None:
    findings = verify(path, _THREADS)
    if len(findings.bad_rows) or findings.damaged:
        raise StoreIncomplete(
            f"{path}: damaged, so nothing was merged:\n"
            + "\n".join(f"  {line}" for line in findings.lines())
            + f"\n{findings.advice()}"
        )


def _plan(joined: Joined) -> str:
    """Names what the merged store will hold."""
    first = joined.runs[0].store
    said = {
        "spec": first.spec["digest"],
        "dtypes": [str(first.array(FEATURES).dtype), str(_sensor_dtype(joined.stores))],
        "sources": joined.sources,
        "episodes": [(one.digest, one.source, one.id) for one in joined.episodes],
    }
    return MERGED + hashlib.blake2b(json.dumps(said).encode(), digest_size=16).hexdigest()


def _arrays(joined: Joined) -> dict[str, ArraySpec]:
    stores, edges = joined.stores, {kind: int(edge[-1]) for kind, edge in joined.edges.items()}
    features = read_specs(stores[0].path)[FEATURES]
    sizes = Sizes(
        episodes=len(joined.episodes),
        ticks=edges["tick"],
        vl_rows=edges["vl"],
        readings=edges["sensor"],
        states=edges["state"],
        text_bytes=edges["text"],
        slots=features.shape[1],
        dim=features.shape[2],
        views=stores[0].array("vl/frame_time").shape[1],
        action_dim=stores[0].action_dim,
        sensor_channels=max(one.sensor_channels for one in stores),
        state_dim=max(one.state_dim for one in stores),
    )
    stored = features.attributes.get("dtype", features.dtype.name)
    return arrays(sizes, stored, _sensor_dtype(stores).name)


def _sensor_dtype(stores: Sequence[FeatureStore]) -> np.dtype[Any]:
    having = [one for one in stores if one.sensor_channels] or list(stores)
    return having[0].array("sensor/values").dtype


def _lay_out(build: StoreBuild, joined: Joined, inodes: Sequence[Inode | None]) -> None:
    """Everything but the feature rows; whole chunks at the first input's beginning are linked."""
    first = joined.runs[0]
    specs = {store.path: read_specs(store.path) for store in joined.stores}
    ends = {
        name: first.rows(axis_kind(spec)).stop
        for name, spec in build.specs.items()
        if name not in INCREMENTAL and not name.startswith("episode/")
    }
    _check_space(build, specs[first.store.path], ends)
    build.create()
    for name, rows in ends.items():
        build.link_unchanged(name, first.store.path, specs[first.store.path][name], rows)
    build.allocate()
    for name in tqdm(ends, "streams", unit="array", disable=None, leave=False):
        for run in joined.runs:
            copy_stream(build, run, specs[run.store.path][name])
    for kind, edge in joined.edges.items():
        build.write(f"episode/{kind}_start", 0, edge)
    build.write("episode/source", 0, joined.source_indices)
    build.write("episode/text", 0, joined.text)
    for store, before in zip(joined.stores, inodes, strict=True):
        refuse_replaced(store.path, before)
    vl = zarr.open_group(first.store.path, path="vl", mode="r").attrs.asdict()
    build.finish_layout(_attributes(joined), vl)


def _check_space(build: StoreBuild, first: Mapping[str, ArraySpec], ends: dict[str, int]) -> None:
    linked = sum(
        build.linkable(name, first[name], rows) * build.specs[name].chunk_bytes
        for name, rows in ends.items()
    )
    needed = sum(spec.data_bytes for spec in build.specs.values()) - linked
    free = free_bytes(build.part)
    if needed > free:
        raise DiskFull(
            f"{build.target}: the merged store needs {size(needed)}, "
            f"{build.part.parent} has {size(free)} free. Make room, or name a place on "
            "another disk with --into."
        )


def _attributes(joined: Joined) -> dict[str, Any]:
    """Those of the first input, with the sources and streams of all."""
    its_own = ("plan", ATTRIBUTE)
    first = {name: one for name, one in joined.stores[0].attrs.items() if name not in its_own}
    return {
        **first,
        "sources": list(joined.sources),
        "streams": joined.streams,
        "environment": [],
    }


def _fill(build: StoreBuild, joined: Joined) -> None:
    """Copy the feature rows that are missing, with their keys and environments."""
    missing = build.missing()
    total = int(joined.edges["vl"][-1])
    with tqdm(
        total=total, initial=total - len(missing), desc="merge", unit="row", disable=None
    ) as progress:
        for run in joined.runs:
            rows, shift = run.rows("vl"), run.shift("vl")
            first, stop = np.searchsorted(missing, [rows.start + shift, rows.stop + shift])
            for count in copy_features(build, run, missing[first:stop] - shift):
                progress.update(count)
