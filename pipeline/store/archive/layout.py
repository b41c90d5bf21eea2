"""How an array of a store is cut into shards and inner chunks.

A shard holds whole chunk files of the store, so that both copies are read and written once, in
order, with one shard in memory.
"""

import math
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import zarr

from pipeline.store.archive.codecs import Codec, checked, outside_the_specification
from pipeline.store.schema import ArraySpec

SHARD_BYTES = 256 * 2**20
"""Raw bytes of a shard at most, where one chunk file of the store is not larger."""
INNER_BYTES = 4 * 2**20
"""Raw bytes of an inner chunk at most, where one row is not larger."""


def shards(spec: ArraySpec, array: "zarr.Array[Any]") -> Iterator[range]:
    """The chunk files of the store that each shard of the array in the archive holds."""
    assert array.shards is not None, "an archive is sharded"
    step = array.shards[0] // spec.chunk_rows
    for start in range(0, spec.chunk_count, step):
        yield range(start, min(start + step, spec.chunk_count))


def rows_of(spec: ArraySpec, chunks: range) -> range:
    """The rows of the array that lie in these chunk files."""
    return range(spec.chunk_rows_of(chunks.start).start, spec.chunk_rows_of(chunks[-1]).stop)


def inner_rows(spec: ArraySpec) -> int:
    """Rows of an inner chunk: the most that divide a chunk of the store and are not too large."""
    parts = min(spec.chunk_rows, max(1, math.ceil(spec.chunk_bytes / INNER_BYTES)))
    return spec.chunk_rows // next(part for part in count(parts) if not spec.chunk_rows % part)


def create_array(root: Path, spec: ArraySpec, codec: Codec) -> "zarr.Array[Any]":
    """The array in an archive, still without data, with the attributes it has in the store."""
    widths = tuple(max(1, size) for size in spec.shape[1:])
    with outside_the_specification():
        return zarr.create_array(
            store=root,
            name=spec.name,
            shape=spec.shape,
            shards=(_chunks_a_shard(spec) * spec.chunk_rows, *widths),
            chunks=(inner_rows(spec), *widths),
            dtype=spec.dtype,
            filters=list(codec.filters),
            compressors=checked(codec.compressors),
            fill_value=0,
            dimension_names=spec.dimensions,
            attributes=dict(spec.attributes),
        )


def open_array(root: Path, name: str) -> "zarr.Array[Any]":
    """An array of an archive."""
    with outside_the_specification():
        return zarr.open_array(root, path=name, mode="r")


def shard_path(root: Path, array: "zarr.Array[Any]", index: int) -> Path:
    """The file of one shard."""
    key = array.metadata.encode_chunk_key((index, *(0,) * (array.ndim - 1)))
    return root / array.path / key


def _chunks_a_shard(spec: ArraySpec) -> int:
    """As few shards as can be, all but the last of one size."""
    most = max(1, SHARD_BYTES // max(1, spec.chunk_bytes))
    return math.ceil(spec.chunk_count / max(1, math.ceil(spec.chunk_count / most))) or 1
