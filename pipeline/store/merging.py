"""Merge finished stores of one feature spec and one embodiment into one, without the model.

The merged store is built like any other, in one go: nothing is computed, so that a merge that was
killed begins again. It has a plan of its own, because it cannot know the params that would describe
all its recordings: `stages.extract` over all the sources lays the store out anew, and takes every
row from it by key without loading the model.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.differences import describe, differences
from pipeline.base.errors import ConfigError, StoreMismatch
from pipeline.base.printed_commands import command
from pipeline.base.provenance import (
    RATE_TOLERANCE,
    join_tuned_on,
    spread,
    tuned_on_attributes,
    tuned_on_of_store,
)
from pipeline.store.chunks import (
    METADATA_DIGEST,
    SEAL,
    check_row_checksums,
    check_trailers,
    read_rows,
)
from pipeline.store.episodes import Episode, index_arrays
from pipeline.store.golden_rows import GOLDEN, GoldenFrames, read_golden
from pipeline.store.lock import build_lock
from pipeline.store.paths import (
    MERGED,
    group_attributes,
    part_path,
    read_plan,
    recover,
    unfinished_plans,
)
from pipeline.store.reader import FeatureStore
from pipeline.store.schema import (
    ARRAY_NAMES,
    BASIS,
    CHECKSUMS,
    FEATURES,
    KEYS,
    POSITIONS,
    STREAMS,
    ArraySpec,
    read_spec,
)
from pipeline.store.writer import StoreBuild, environment_runs

_COPIED = [name for name in ARRAY_NAMES if name.split("/")[0] in STREAMS]
_BLOCK_BYTES = 32 * 2**20

# Attributes of an input's root that would be wrong in the merged store.
_NOT_TAKEN = (METADATA_DIGEST, SEAL, GOLDEN)


@dataclass(frozen=True)
class ConsecutiveRows:
    """Episodes that follow one another both in an input and in the merged store.

    For each stream, `rows` has their rows in the input, and `shift` what is added to row numbers in
    the merged store.
    """

    store: FeatureStore
    rows: Mapping[str, range]
    shift: Mapping[str, int]

    def blocks(self, name: str) -> Iterator[tuple[range, NDArray[Any]]]:
        """The run's rows of an array of the input and their values, by block.

        Reads with plain system calls, so that a truncated file is an error and not a SIGBUS.
        """
        spec = read_spec(self.store.path, name)
        rows = self.rows[name.split("/")[0]]
        step = max(1, _BLOCK_BYTES // max(1, spec.row_bytes))
        for block in (rows[at : at + step] for at in range(0, len(rows), step)):
            yield block, read_rows(self.store.path, spec, block.start, block.stop)


class MergedIndex:
    """The episodes of several stores one after the other; those of equal digest only once.

    Different episodes of the same name, such as from two places that both call a source `lab`, get
    the number of their store before their name, and that is printed. `arrays` has the arrays under
    `episode/`; `twice` counts the episodes that an earlier input also has.
    """

    def __init__(self, stores: Sequence[FeatureStore]) -> None:
        self.stores = stores
        self.sources = list(dict.fromkeys(name for store in stores for name in store.sources))
        self.episodes: list[Episode] = []
        taken: list[tuple[FeatureStore, Episode]] = []
        digests: set[str] = set()
        names: set[tuple[str, str]] = set()
        for number, store in enumerate(stores, start=1):
            for episode in store.episodes:
                if episode.digest in digests:
                    continue
                digests.add(episode.digest)
                if (episode.source, episode.id) in names:
                    was, episode = episode, replace(episode, id=f"{number}/{episode.id}")
                    print(f"{store.path}: {was.source}/{was.id} is named {episode.id}")
                names.add((episode.source, episode.id))
                taken.append((store, episode))
                self.episodes.append(episode)
        self.twice = sum(len(store.episodes) for store in stores) - len(self.episodes)
        self.arrays = index_arrays(self.episodes, self.sources)
        self.runs = [*self._runs(taken)]

    def _runs(self, taken: Sequence[tuple[FeatureStore, Episode]]) -> Iterator[ConsecutiveRows]:
        """The episodes in runs, as long as possible."""
        numbered = ((store, episode, at) for at, (store, episode) in enumerate(taken))
        for _, group in groupby(numbered, lambda it: (it[0].path, it[1].index - it[2])):
            run = list(group)
            (store, first, begin), (_, last, _) = run[0], run[-1]
            rows = {
                name: range(getattr(first, stream.rows).start, getattr(last, stream.rows).stop)
                for name, stream in STREAMS.items()
            }
            shift = {
                name: int(self.arrays[f"episode/{name}_start"][begin]) - inside.start
                for name, inside in rows.items()
            }
            yield ConsecutiveRows(store, rows, shift)

    @property
    def plan(self) -> str:
        """Identifies what the merged store will hold."""
        arrays = self.stores[0].array(FEATURES), self.having("sensor").array("sensor/values")
        document = {
            "spec": self.stores[0].spec["digest"],
            "dtypes": [str(array.dtype) for array in arrays],
            "sources": self.sources,
            "episodes": [(episode.digest, episode.source, episode.id) for episode in self.episodes],
        }
        return MERGED + hashlib.blake2b(json.dumps(document).encode(), digest_size=16).hexdigest()

    @property
    def specs(self) -> dict[str, ArraySpec]:
        """The arrays of the merged store: as in the inputs, but long enough for all episodes."""
        specs: dict[str, ArraySpec] = {}
        for name in ARRAY_NAMES:
            stream = name.split("/")[0]
            spec = read_spec(self.having(stream).path, name)
            rows = len(self.arrays[name]) if name in self.arrays else self.count(stream)
            specs[name] = replace(spec, shape=(rows, *spec.shape[1:]), stored_chunk_rows=None)
        if self.stores[0].basis is not None:
            specs[BASIS] = read_spec(self.stores[0].path, BASIS)
        return specs

    def having(self, stream: str) -> FeatureStore:
        """The first store that has this stream, or the first store if none has it."""
        return next((store for store in self.stores if _has(store, stream)), self.stores[0])

    def count(self, stream: str) -> int:
        """Rows of a stream."""
        return int(self.arrays[f"episode/{stream}_start"][-1])


def merge(inputs: Sequence[Path], output: Path | None) -> MergedIndex | None:
    """Make `output` from the episodes of all inputs, in order; None if it already is that store.

    An episode in several inputs (equal digest) is taken once, from the first. Memory stays bounded;
    every feature row must match its checksum. The inputs are only read.

    Raises `ConfigError` for paths that cannot be merged, `StoreMismatch` where specs or embodiments
    differ or `output` holds something else, `StoreIncomplete` where an input is damaged,
    `StoreLocked` and `DiskFull`.
    """
    output = _checked_output(inputs, output)
    with build_lock(output):
        recover(output)
        stores = [FeatureStore.open(path) for path in inputs]
        inodes = [path.stat().st_ino for path in inputs]
        _check_alike(stores)
        merged = MergedIndex(stores)
        plan = merged.plan
        if read_plan(output) == plan:
            FeatureStore.open(output)  # refuses a store that changed after sealing
            print(f"{output}: up to date, nothing to do")
            return None
        _check_free(output, plan)
        for store in stores:
            check_trailers(store.path)
            store.array("tick/vl_row")  # checks the positions that ticks hold
        with closing(StoreBuild(output, merged.specs, plan)) as build:
            _copy(build, merged)
            for store, inode in zip(stores, inodes, strict=True):
                if store.path.stat().st_ino != inode:
                    raise StoreMismatch(
                        f"{store.path}: another store took its place meanwhile. Merge again."
                    )
            build.write_golden(_golden(merged))
            build.seal()
    return merged


def _checked_output(inputs: Sequence[Path], output: Path | None) -> Path:
    """The place of the merged store; raises `ConfigError` for paths that cannot be merged."""
    places = [path.resolve() for path in inputs]
    if len(places) < 2 or len(set(places)) < len(places):
        raise ConfigError(
            "stores.inputs: expected two or more stores, each named once, found "
            f"{', '.join(map(str, inputs)) or 'none'}. "
            f"Name them: {command('store', 'merge A.zarr B.zarr --into C.zarr')}"
        )
    if output is None or output.suffix != ".zarr" or output.resolve() in places:
        raise ConfigError(
            f"stores.output: expected a new store whose name ends in .zarr, found {output}. "
            "A finished store is never modified: name another place with --into C.zarr."
        )
    return output


def _check_free(output: Path, plan: str) -> None:
    """Raise `StoreMismatch` where the output's place holds another store or build."""
    plans = {output: {read_plan(output)}, part_path(output): {*unfinished_plans(output)}}
    for place, present in plans.items():
        if present - {None, plan}:
            raise StoreMismatch(
                f"{place}: expected nothing there, or a merge of these very stores; found another. "
                "Choose another name with --into, or remove it."
            )


def _check_alike(stores: Sequence[FeatureStore]) -> None:
    """Raise `StoreMismatch` that names what differs in spec, embodiment, rate or reuse."""
    agreed: dict[str, Any] = {}
    for store in stores:
        form = _form(store)
        hz, rate = agreed.get("action_hz"), form["action_hz"]
        if hz and rate and abs(hz - rate) <= RATE_TOLERANCE * hz:  # measured rates differ a little
            form["action_hz"] = hz
        differing = differences({name: agreed.get(name, form[name]) for name in form}, form)
        if differing:
            raise StoreMismatch(
                f"{stores[0].path} and {store.path} cannot become one store, which has one feature "
                "spec and one embodiment; there they differ (first -> second):\n  "
                + "\n  ".join(describe(differing))
                + "\nExtract one of them again as the other was (extract.dtype's basis names the "
                "store whose basis is taken), or keep two stores."
            )
        agreed = form | agreed


def _form(store: FeatureStore) -> dict[str, Any]:
    """What two stores must agree on, if both have it."""
    features = store.array(FEATURES)
    streams = {
        name: {"dtype": store.array(f"{name}/values").dtype.name, **store.streams[name]}
        for name in ("sensor", "state")
        if _has(store, name)
    }
    return {
        "feature spec": store.spec,
        "features": {"row": list(features.shape[1:]), "dtype": features.dtype.name},
        "action": store.streams["action"],
        "views": store.streams["views"],
        "action_hz": store.action_hz,
        "vlm_reuse_count": store.vlm_reuse_count,
        **streams,
    }


def _has(store: FeatureStore, stream: str) -> bool:
    """Whether a store has this stream; only sensor and state may be absent."""
    return stream not in ("sensor", "state") or store.array(f"{stream}/values").shape[1] > 0


def _copy(build: StoreBuild, merged: MergedIndex) -> None:
    """Write everything; link whole chunks at the start of the first input.

    Raises `StoreIncomplete`, which names a feature row that does not give its checksum.
    """
    first = merged.stores[0]
    build.create()
    for name in _COPIED:
        rows = merged.runs[0].rows[name.split("/")[0]]
        build.link_unchanged(name, first.path, read_spec(first.path, name), rows.stop)
    build.allocate()
    for name, values in merged.arrays.items():
        build.write(name, 0, values)
    if first.basis is not None:
        build.write(BASIS, 0, first.basis.maps)
    for name in tqdm(_COPIED, "merge", unit="array", disable=None, leave=False):
        for run in merged.runs:
            for rows, values in run.blocks(name):  # `write` skips linked chunks
                if name in POSITIONS:
                    values += run.shift[POSITIONS[name]]
                if name == FEATURES:
                    store, sums = run.store, run.store.array(CHECKSUMS)[rows.start : rows.stop]
                    spec = read_spec(store.path, name)
                    check_row_checksums(store.path, spec, rows, values, sums)
                build.write(name, rows.start + run.shift[name.split("/")[0]], values)
    streams = {name: merged.having(name).streams[name] for name in ("sensor", "state")}
    tuned = join_tuned_on(tuned_on_of_store(store.attrs, store.path) for store in merged.stores)
    its_own = {
        "sources": merged.sources,
        "streams": first.streams | streams,
        "environment": _environment(merged),
    }
    attrs = {name: value for name, value in first.attrs.items() if name not in _NOT_TAKEN}
    of_vl = group_attributes(first.path / "vl")
    build.finish_layout(attrs | its_own | tuned_on_attributes(tuned), of_vl)


def _environment(merged: MergedIndex) -> list[dict[str, Any]]:
    """The software and hardware that computed each range of rows."""
    ranges: list[dict[str, Any]] = []
    for run in merged.runs:
        shift, rows = run.shift["vl"], np.array(run.rows["vl"], np.int64)
        for environment, part in environment_runs(run.store.attrs["environment"], rows):
            begin, end = part.start + shift, part.stop + shift
            if ranges and ranges[-1] == {"rows": ranges[-1]["rows"], **environment}:
                begin = ranges.pop()["rows"][0]
            ranges.append({"rows": [begin, end], **environment})
    return ranges


def _golden(merged: MergedIndex) -> list[GoldenFrames]:
    """Golden rows of the merged store, chosen from those of the inputs, which are checked again."""
    inputs = {store.path: read_golden(store.path, store.array(KEYS)) for store in merged.stores}
    known = [
        replace(golden, row=golden.row + run.shift["vl"])
        for run in merged.runs
        for golden in inputs[run.store.path]
        if golden.row in run.rows["vl"]
    ]
    views = np.array([len(golden.frames) for golden in known], np.int64)
    return [known[place] for place in spread(np.arange(len(known)), views)]
