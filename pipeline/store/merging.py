"""Several finished stores of one feature spec and one embodiment become one, without the model.

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
from dataclasses import dataclass, replace
from itertools import pairwise, takewhile
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.differences import describe, differences
from pipeline.base.errors import ConfigError, StoreMismatch
from pipeline.store.chunks import check_row_checksums, check_trailers, read_rows
from pipeline.store.environments import environment_at
from pipeline.store.episodes import SAID, Episode, EpisodeRows, episode_arrays
from pipeline.store.lock import build_lock
from pipeline.store.metadata import ATTRIBUTE as METADATA_DIGEST
from pipeline.store.metadata import check_metadata
from pipeline.store.paths import MERGED, part_path, read_plan, recover
from pipeline.store.reader import FeatureStore
from pipeline.store.repair_hints import gc_command
from pipeline.store.replacement import Inode, inode_of, refuse_replaced
from pipeline.store.schema import ARRAY_NAMES, CHECKSUMS, FEATURES, KEYS, ArraySpec, read_spec
from pipeline.store.writer import StoreBuild

Say = Callable[[str], None]
RowRun = tuple[FeatureStore, range, int]
"""An input, rows of it that stay together, and by how much their numbers grow."""
_ROWS = {"vl": "vl_rows", "sensor": "readings", "state": "states"}
"""Streams that are copied, and what `Episode` calls its rows of them."""
_COPIED = ("vl/slot_valid", "sensor/values", "sensor/time", "state/values", "state/time")
_BLOCK_BYTES = 32 * 2**20


@dataclass(frozen=True)
class MergeReport:
    """What was done."""

    store: Path
    episodes: int
    twice: int
    """Episodes that an earlier input holds just so."""
    rows: int


@dataclass(frozen=True)
class StoredTicks:
    """The ticks of an episode of a store, with indices into its own streams."""

    time: NDArray[np.float64]
    action: NDArray[np.float32]
    vl_row: NDArray[np.int64]
    sensor_end: NDArray[np.int64]
    state_end: NDArray[np.int64]
    vl_time: NDArray[np.float64]
    vl_frame_time: NDArray[np.float64]

    def frame_times(self, views: Sequence[str]) -> NDArray[np.float64]:
        """(vl_row, view) s; stores that are merged have the same views."""
        return self.vl_frame_time


class MergedEpisodes:
    """The episodes of several stores one behind the other, those of equal digest once.

    Different episodes of one name, as of two places that both call a source `lab`, are named apart
    by their store, which `say` is told.
    """

    def __init__(self, stores: Sequence[FeatureStore], say: Say) -> None:
        self.stores = stores
        self.sources = list(dict.fromkeys(name for store in stores for name in store.sources))
        self.origins: list[tuple[FeatureStore, Episode]] = []
        self.rows: list[EpisodeRows] = []
        digests: set[str] = set()
        names: dict[tuple[str, str], Path] = {}
        for store, episode in [(held, one) for held in stores for one in held.episodes]:
            if episode.digest in digests:
                continue
            digests.add(episode.digest)
            name = _free_name(episode, store.path, names)
            if name != episode.id:
                say(
                    f"{episode.source}/{episode.id} is one episode in "
                    f"{names[episode.source, episode.id]} and another in {store.path}, which is "
                    f"named {episode.source}/{name}"
                )
            names[episode.source, name] = store.path
            self.origins.append((store, episode))
            self.rows.append(_episode_rows(store, episode, name))
        self.arrays = episode_arrays(self.rows, self.sources, stores[0].streams["views"])

    @property
    def plan(self) -> str:
        """Names what the merged store will hold."""
        arrays = self.stores[0].array(FEATURES), self.having("sensor").array("sensor/values")
        said = {
            "spec": self.stores[0].spec["digest"],
            "dtypes": [str(array.dtype) for array in arrays],
            "sources": self.sources,
            "episodes": [(rows.said["digest"], rows.source, rows.said["id"]) for rows in self.rows],
        }
        return MERGED + hashlib.blake2b(json.dumps(said).encode(), digest_size=16).hexdigest()

    @property
    def specs(self) -> dict[str, ArraySpec]:
        """The arrays of the merged store: those of the inputs, as long as all episodes need."""
        specs: dict[str, ArraySpec] = {}
        for name in ARRAY_NAMES:
            stream = name.split("/")[0]
            spec = read_spec(self.having(stream).path, name)
            known = self.arrays.get(name)
            rows = self.starts(stream)[-1] if known is None else len(known)
            shape = (int(rows), *spec.shape[1:])
            specs[name] = replace(spec, shape=shape, stored_chunk_rows=None)
        return specs

    def having(self, stream: str) -> FeatureStore:
        """The first store that has this stream, or else the first store."""
        return next((store for store in self.stores if _has(store, stream)), self.stores[0])

    def starts(self, stream: str) -> NDArray[np.int64]:
        """(episode + 1,) where each episode's rows begin."""
        return self.arrays[f"episode/{stream}_start"]

    def runs(self, stream: str) -> list[RowRun]:
        """All rows of a stream that is copied, in order."""
        runs: list[RowRun] = []
        for (store, episode), start in zip(self.origins, self.starts(stream)[:-1], strict=True):
            rows: range = getattr(episode, _ROWS[stream])
            if runs and runs[-1][0] is store and runs[-1][1].stop == rows.start:
                _, before, shift = runs.pop()
                runs.append((store, range(before.start, rows.stop), shift))
            else:
                runs.append((store, rows, int(start) - rows.start))
        return runs


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
        stores = [FeatureStore.open(path) for path in inputs]
        _check_alike(stores)
        merged = MergedEpisodes(stores, say)
        plan = merged.plan
        part = read_plan(part_path(output))
        if read_plan(output) == plan and part != plan:  # else a repair of it has begun
            FeatureStore.open(output)  # refuses a store that files are missing from
            check_metadata(output)
            say(f"{output}: up to date, nothing to do")
            return None
        _check_free(output, plan)
        for path in inputs:
            check_trailers(path)
        with closing(StoreBuild(output, merged.specs, plan)) as build:
            if part == plan and build.layout_damage() is None:
                say(f"continuing the interrupted build {build.part}")
            else:
                _lay_out(build, merged, inodes)
            _fill(build, merged)
            build.seal()
    kept = len(merged.rows)
    twice = sum(len(store.episodes) for store in stores) - kept
    return MergeReport(output, kept, twice, int(merged.starts("vl")[-1]))


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


def _check_alike(stores: Sequence[FeatureStore]) -> None:
    """Raise `StoreMismatch` that names what differs in spec, embodiment, rate or reuse."""
    known: dict[str, Any] = {}
    for store in stores:
        form = _form(store)
        differing = differences({name: known.get(name, form[name]) for name in form}, form)
        if differing:
            # The example prompt last: it differs where views, slots or prompt do.
            ranked = sorted(differing, key=lambda place: "example_prompt" in place)
            lines = describe({place: differing[place] for place in ranked})
            raise StoreMismatch(
                f"{stores[0].path} and {store.path} cannot become one store, which has one feature "
                "spec and one embodiment; there they differ (first -> second):\n  "
                + "\n  ".join(lines)
                + "\nExtract one of them again as the other was, or keep two stores."
            )
        known = form | known


def _form(store: FeatureStore) -> dict[str, Any]:
    """What two stores have to agree on, where both have it."""
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


def _free_name(episode: Episode, store: Path, names: Mapping[tuple[str, str], Path]) -> str:
    name, number = episode.id, 1
    while (episode.source, name) in names:
        prefix = store.stem if number == 1 else f"{store.stem}-{number}"
        name, number = f"{prefix}/{episode.id}", number + 1
    return name


def _episode_rows(store: FeatureStore, episode: Episode, name: str) -> EpisodeRows:
    """An episode of an input as the merged store lays it out."""

    def rows(array: str) -> NDArray[Any]:
        span = episode.ticks if array.startswith("tick/") else episode.vl_rows
        return store.array(array)[span.start : span.stop]

    ticks = StoredTicks(
        time=rows("tick/time"),
        action=rows("tick/action"),
        vl_row=rows("tick/vl_row") - episode.vl_rows.start,
        sensor_end=rows("tick/sensor_end") - episode.readings.start,
        state_end=rows("tick/state_end") - episode.states.start,
        vl_time=rows("vl/time"),
        vl_frame_time=rows("vl/frame_time"),
    )
    said = {field: getattr(episode, field) for field in SAID} | {"id": name}
    return EpisodeRows(ticks, len(episode.readings), len(episode.states), episode.source, said)


def _lay_out(build: StoreBuild, merged: MergedEpisodes, inodes: Sequence[Inode | None]) -> None:
    """Everything but the feature rows; whole chunks at the first input's beginning are linked."""
    first, runs = merged.stores[0], {name: merged.runs(name.split("/")[0]) for name in _COPIED}
    build.create()
    for name in _COPIED:
        _, rows, _ = runs[name][0]
        build.link_unchanged(name, first.path, read_spec(first.path, name), rows.stop)
    build.allocate()
    for name, values in merged.arrays.items():
        build.write(name, 0, values)
    for name in tqdm(_COPIED, "streams", unit="array", disable=None, leave=False):
        for store, rows, shift in runs[name]:
            _copy_rows(build, name, store.path, rows, shift)
    for store, inode in zip(merged.stores, inodes, strict=True):
        refuse_replaced(store.path, inode)
    streams = {name: merged.having(name).streams[name] for name in ("sensor", "state")}
    its_own = {"sources": merged.sources, "streams": first.streams | streams, "environment": []}
    attrs = {name: value for name, value in first.attrs.items() if name != METADATA_DIGEST}
    vl = zarr.open_group(first.path, path="vl", mode="r").attrs.asdict()
    build.finish_layout(attrs | its_own, vl)


def _copy_rows(build: StoreBuild, name: str, store: Path, rows: range, shift: int) -> None:
    """Write rows of an input in blocks, those in linked chunks left out.

    Read with plain system calls: a file that was cut off is an error, not a SIGBUS.
    """
    source, target = read_spec(store, name), build.specs[name]
    chunks = takewhile(build.files(name).is_linked, range(target.chunk_count))
    linked = sum(1 for _ in chunks) * target.chunk_rows
    step = max(1, _BLOCK_BYTES // max(1, source.row_bytes))
    for start in range(max(rows.start, linked - shift), rows.stop, step):
        values = read_rows(store, source, start, min(start + step, rows.stop))
        build.write(name, start + shift, values)


def _fill(build: StoreBuild, merged: MergedEpisodes) -> None:
    """Copy the feature rows that are missing, with their keys and environments.

    In blocks of one environment, which are copied whole. Raises `StoreIncomplete` naming a row that
    does not give its checksum.
    """
    missing, spec = build.missing(), build.specs[FEATURES]
    total, step = spec.shape[0], max(1, _BLOCK_BYTES // max(1, spec.row_bytes))
    done = total - len(missing)
    with tqdm(total=total, initial=done, desc="merge", unit="row", disable=None) as progress:
        for store, rows, shift in merged.runs("vl"):
            source, noted = read_spec(store.path, FEATURES), store.attrs["environment"]
            edges = {edge for environment in noted for edge in environment["rows"] if edge in rows}
            for start, stop in pairwise(sorted({*rows[::step], *edges, rows.stop})):
                first, last = np.searchsorted(missing, [start + shift, stop + shift])
                if first == last:
                    continue
                values = read_rows(store.path, source, start, stop)
                checksums = store.array(CHECKSUMS)[start:stop]
                check_row_checksums(store.path, source, start, values, checksums)
                keys = [key.tobytes() for key in store.array(KEYS)[start:stop]]
                number = build.environment_index(environment_at(noted, start))
                build.commit(range(start + shift, stop + shift), values, keys, number)
                progress.update(last - first)
