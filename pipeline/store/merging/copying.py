"""Rows of a finished store, copied into a build block by block."""

from collections.abc import Iterator
from contextlib import closing
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.store.chunks import ChunkFiles, check_row_checksums
from pipeline.store.environments import environment_at
from pipeline.store.merging.joining import Run
from pipeline.store.reader import FeatureStore
from pipeline.store.schema import CHECKSUMS, FEATURES, KEYS, ArraySpec, read_specs
from pipeline.store.writer import StoreBuild

_BLOCK = 32 * 2**20
_AXES = {"tick": "tick", "vl_row": "vl", "sensor_reading": "sensor", "state_reading": "state"}
_INDICES = {"tick/vl_row": "vl", "tick/sensor_end": "sensor", "tick/state_end": "state"}
"""Arrays that count rows of another kind from the store's beginning."""


def axis_kind(spec: ArraySpec) -> str:
    """What kind of rows an array of streams, ticks or features has."""
    return _AXES[spec.dimensions[0]]


def copy_stream(build: StoreBuild, run: Run, spec: ArraySpec) -> None:
    """An array's rows of a run, a block at a time; indices are counted from their new beginning.

    Read with plain system calls: a file that was cut off is an error, not a SIGBUS.
    """
    kind = axis_kind(spec)
    shift, counted = run.shift(kind), _INDICES.get(spec.name)
    chunks = takewhile(build.files(spec.name).is_linked, range(build.specs[spec.name].chunk_count))
    linked = sum(1 for _ in chunks) * build.specs[spec.name].chunk_rows
    rows = range(max(run.rows(kind).start, linked - shift), run.rows(kind).stop)
    with closing(ChunkFiles(run.store.path, spec, writable=False)) as source:
        for start, count in _blocks(rows, spec.row_bytes):
            values = source.read(start, count)
            if counted is not None:
                values = values + np.int64(run.shift(counted))
            build.write(spec.name, start + shift, values)


def copy_features(build: StoreBuild, run: Run, rows: NDArray[np.int64]) -> Iterator[int]:
    """Copy these feature rows (of the input, ascending) with their keys and environments.

    Yields how many, block by block. Raises `StoreIncomplete` naming a row that does not give its
    checksum.
    """
    store, shift = run.store, run.shift("vl")
    spec = read_specs(store.path)[FEATURES]
    with closing(ChunkFiles(store.path, spec, writable=False)) as features:
        for environment, stretch in _stretches(store, rows):
            number = build.environment_index(environment)
            for start, count in _blocks(stretch, spec.row_bytes):
                values = features.read(start, count)
                wanted = store.array(CHECKSUMS)[start : start + count]
                check_row_checksums(store.path, spec, start, values, wanted)
                keys = [key.tobytes() for key in store.array(KEYS)[start : start + count]]
                build.commit(np.arange(start, start + count) + shift, values, keys, number)
                yield count


def _stretches(
    store: FeatureStore, rows: NDArray[np.int64]
) -> Iterator[tuple[dict[str, Any], range]]:
    """Consecutive rows that were computed in one environment, and that environment."""
    noted = store.attrs["environment"]
    cuts = np.searchsorted(rows, [edge for one in noted for edge in one["rows"]])
    gaps = np.flatnonzero(np.diff(rows) != 1) + 1
    for part in np.split(rows, np.union1d(cuts, gaps)):
        if len(part):
            yield environment_at(noted, int(part[0])), range(int(part[0]), int(part[-1]) + 1)


def _blocks(rows: range, row_bytes: int) -> Iterator[tuple[int, int]]:
    """(first row, count) of blocks of at most 32 MiB."""
    step = max(1, _BLOCK // max(1, row_bytes))
    for start in range(rows.start, rows.stop, step):
        yield start, min(step, rows.stop - start)
