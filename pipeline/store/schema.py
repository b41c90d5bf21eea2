"""What a store holds: its arrays, their dtypes and shapes, and how they lie in files.

Every array is a plain zarr v3 array without compression, chunked along its first axis only, by a
multiple of 4,096 rows. So the data of a chunk file begin at byte 0 and fill whole pages whatever
the width of a row, a 4-byte crc32c trails behind, and the file is at once a zarr chunk and a flat
block that can be mapped.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import BytesCodec, Crc32cCodec

from pipeline.base.errors import StoreIncomplete
from pipeline.store.repair_hints import mend

SCHEMA = 1
ROW_MULTIPLE = 4096
CHUNK_BYTES = 64 * 2**20
TRAILER_BYTES = 4
KEY_BYTES = 16

FEATURES, KEYS, CHECKSUMS = "vl/features", "vl/key", "vl/checksum"
INCREMENTAL = (FEATURES, KEYS, CHECKSUMS)
"""The arrays written row by row while the model works; all others are known beforehand."""


@dataclass(frozen=True)
class StoredStream:
    """Rows of which each episode has a range: those of the arrays `<stream>/…`.

    `episode/<stream>_start` says where the range of each episode begins.
    """

    rows: str
    """What `Episode` calls the range of an episode."""
    row: str
    """How messages call one of them."""
    counted_by: str = ""
    """The array of ticks that holds positions among these rows."""


STREAMS = {
    "tick": StoredStream("ticks", "tick"),
    "vl": StoredStream("vl_rows", "VL row", "tick/vl_row"),
    "sensor": StoredStream("readings", "sensor reading", "tick/sensor_end"),
    "state": StoredStream("states", "state reading", "tick/state_end"),
}


@dataclass(frozen=True)
class ArraySpec:
    """One array of a store: its name, shape, dtype and the names of its axes."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    dimensions: tuple[str, ...]
    attributes: Mapping[str, Any] = field(default_factory=dict)
    stored_chunk_rows: int | None = None
    """As an array on disk is cut; None for one that follows the rule."""

    @property
    def row_bytes(self) -> int:
        """Bytes of one row."""
        return math.prod(self.shape[1:]) * self.dtype.itemsize

    @property
    def data_bytes(self) -> int:
        """Bytes of all rows, padding and trailers left out."""
        return self.shape[0] * self.row_bytes

    @property
    def chunk_rows(self) -> int:
        """Rows a chunk: about 64 MB for wide rows, all of a small array in one."""
        if self.stored_chunk_rows is not None:
            return self.stored_chunk_rows
        wide = max(1, CHUNK_BYTES // (max(1, self.row_bytes) * ROW_MULTIPLE)) * ROW_MULTIPLE
        return min(wide, max(1, math.ceil(self.shape[0] / ROW_MULTIPLE)) * ROW_MULTIPLE)

    @property
    def chunk_bytes(self) -> int:
        """Bytes of a chunk file before its trailer."""
        return self.chunk_rows * self.row_bytes

    @property
    def chunk_count(self) -> int:
        """Number of chunk files; none for an array without data."""
        return math.ceil(self.shape[0] / self.chunk_rows) if self.data_bytes else 0

    def chunk_rows_of(self, chunk: int) -> range:
        """The rows of the array that lie in this chunk."""
        start = chunk * self.chunk_rows
        return range(start, min(start + self.chunk_rows, self.shape[0]))

    def create(self, root: Path | dict[str, Any], **otherwise: Any) -> "zarr.Array[Any]":
        """Write the array's zarr metadata below `root`; an archive cuts and packs it otherwise."""
        as_in_a_store: dict[str, Any] = {
            "chunks": (self.chunk_rows, *(max(1, size) for size in self.shape[1:])),
            "compressors": [Crc32cCodec()],
        }
        return zarr.create_array(
            store=root,
            name=self.name,
            shape=self.shape,
            dtype=self.dtype,
            serializer=BytesCodec() if self.dtype.itemsize > 1 else BytesCodec(endian=None),
            filters=None,
            fill_value=0,
            dimension_names=self.dimensions,
            attributes=dict(self.attributes),
            **(as_in_a_store | otherwise),
        )


def chunk_paths(root: Path, spec: ArraySpec) -> list[Path]:
    """The chunk files of an array on disk, in order."""
    return [chunk_path(root, spec, chunk) for chunk in range(spec.chunk_count)]


def chunk_path(root: Path, spec: ArraySpec, chunk: int) -> Path:
    """A chunk file of an array on disk, under the default chunk keys of zarr v3."""
    return Path(root, spec.name, "c", str(chunk), *["0"] * (len(spec.shape) - 1))


@dataclass(frozen=True)
class Sizes:
    """How long each axis of a store's arrays is; a width of 0 is an absent stream."""

    episode: int
    tick: int
    vl_row: int
    sensor_reading: int
    state_reading: int
    byte: int
    """Of the texts of all episodes."""
    slot: int
    """Of a VL row: those of all its variants, one variant after the other."""
    dim: int
    view: int
    action_dim: int
    channel: int
    """Of the sensor."""
    state_dim: int


_ARRAYS = {
    FEATURES: ("", "vl_row", "slot", "dim"),
    "vl/slot_valid": ("u1", "vl_row", "slot"),
    "vl/time": ("f8", "vl_row"),
    "vl/frame_time": ("f8", "vl_row", "view"),
    KEYS: ("u1", "vl_row", "key_byte"),
    CHECKSUMS: ("u4", "vl_row"),
    "tick/time": ("f8", "tick"),
    "tick/action": ("f4", "tick", "action_dim"),
    "tick/vl_row": ("i8", "tick"),
    "tick/sensor_end": ("i8", "tick"),
    "tick/state_end": ("i8", "tick"),
    "sensor/values": ("", "sensor_reading", "channel"),
    "sensor/time": ("f8", "sensor_reading"),
    "state/values": ("f4", "state_reading", "state_dim"),
    "state/time": ("f8", "state_reading"),
    **{f"episode/{stream}_start": ("i8", "episode_edge") for stream in (*STREAMS, "text")},
    "episode/source": ("i4", "episode"),
    "episode/text": ("u1", "byte"),
}
"""Every array in the order of the contract: its type, where none of the params says so, and axes.
"""
ARRAY_NAMES = tuple(_ARRAYS)
GROUPS = tuple(sorted({name.partition("/")[0] for name in ARRAY_NAMES}))


def arrays(sizes: Sizes, features_dtype: str, sensor_dtype: str) -> dict[str, ArraySpec]:
    """Every array of a store, by name, in the order of the contract."""
    lengths = {**vars(sizes), "episode_edge": sizes.episode + 1, "key_byte": KEY_BYTES}
    chosen = {FEATURES: features_dtype, "sensor/values": sensor_dtype}
    return {
        name: array_spec(name, tuple(lengths[axis] for axis in axes), chosen.get(name))
        for name, (_, *axes) in _ARRAYS.items()
    }


def array_spec(name: str, shape: tuple[int, ...], dtype: str | None = None) -> ArraySpec:
    """An array as the contract says; `dtype` is one of `DTYPES` where params choose it."""
    code, *axes = _ARRAYS[name]
    bits = name == FEATURES and dtype == "bfloat16"
    return ArraySpec(
        name,
        shape,
        np.dtype("u2" if bits else code or dtype).newbyteorder("<"),
        tuple(axis.removeprefix("key_") for axis in axes),
        {"dtype": dtype} if bits else {},
    )


def read_specs(root: Path) -> dict[str, ArraySpec]:
    """The arrays of a store or a build on disk, by name, as `read_spec` reads them."""
    return {name: read_spec(root, name) for name in ARRAY_NAMES}


def read_spec(root: Path, name: str) -> ArraySpec:
    """An array of a store or a build as its metadata on disk say.

    Raises `StoreIncomplete` where they are missing or cannot be read.
    """
    try:
        array = zarr.open_array(root, path=name, mode="r")
    except (FileNotFoundError, ValueError, KeyError, TypeError) as error:
        raise StoreIncomplete(
            f"{root / name / 'zarr.json'}: not the metadata of a zarr array ({error}). {mend(root)}"
        ) from None
    names = getattr(array.metadata, "dimension_names", None) or ()
    return ArraySpec(
        name,
        array.shape,
        array.dtype,
        tuple(str(axis) for axis in names),
        array.attrs.asdict(),
        stored_chunk_rows=array.chunks[0],
    )
