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

    def create(self, root: Path) -> None:
        """Write the array's zarr metadata below `root`."""
        zarr.create_array(
            store=root,
            name=self.name,
            shape=self.shape,
            chunks=(self.chunk_rows, *(max(1, size) for size in self.shape[1:])),
            dtype=self.dtype,
            serializer=BytesCodec() if self.dtype.itemsize > 1 else BytesCodec(endian=None),
            compressors=[Crc32cCodec()],
            filters=None,
            fill_value=0,
            dimension_names=self.dimensions,
            attributes=dict(self.attributes),
        )


def chunk_paths(root: Path, spec: ArraySpec) -> list[Path]:
    """The chunk files of an array on disk, in order, under the default chunk keys of zarr v3."""
    zeros = ["0"] * (len(spec.shape) - 1)
    return [Path(root, spec.name, "c", str(chunk), *zeros) for chunk in range(spec.chunk_count)]


@dataclass(frozen=True)
class Sizes:
    """How many of each thing a store holds; a width of 0 is an absent stream."""

    episodes: int
    ticks: int
    vl_rows: int
    readings: int
    states: int
    text_bytes: int
    slots: int
    """Of a VL row: those of all its variants, one variant after the other."""
    dim: int
    views: int
    action_dim: int
    sensor_channels: int
    state_dim: int


def arrays(sizes: Sizes, features_dtype: str, sensor_dtype: str) -> dict[str, ArraySpec]:
    """Every array of a store, by name, in the order of the contract."""
    s = sizes
    bfloat16 = features_dtype == "bfloat16"
    stored = np.dtype("<u2" if bfloat16 else features_dtype)
    bits = {"dtype": "bfloat16"} if bfloat16 else {}
    f4, f8, i4, i8, u1, u4 = (np.dtype(f"<{code}") for code in ("f4", "f8", "i4", "i8", "u1", "u4"))
    edge = s.episodes + 1
    view = ("vl_row", "view")
    return {
        spec.name: spec
        for spec in (
            ArraySpec(
                FEATURES, (s.vl_rows, s.slots, s.dim), stored, ("vl_row", "slot", "dim"), bits
            ),
            ArraySpec("vl/slot_valid", (s.vl_rows, s.slots), u1, ("vl_row", "slot")),
            ArraySpec("vl/time", (s.vl_rows,), f8, ("vl_row",)),
            ArraySpec("vl/frame_time", (s.vl_rows, s.views), f8, view),
            ArraySpec(KEYS, (s.vl_rows, KEY_BYTES), u1, ("vl_row", "byte")),
            ArraySpec(CHECKSUMS, (s.vl_rows,), u4, ("vl_row",)),
            ArraySpec("tick/time", (s.ticks,), f8, ("tick",)),
            ArraySpec("tick/action", (s.ticks, s.action_dim), f4, ("tick", "action_dim")),
            ArraySpec("tick/vl_row", (s.ticks,), i8, ("tick",)),
            ArraySpec("tick/sensor_end", (s.ticks,), i8, ("tick",)),
            ArraySpec("tick/state_end", (s.ticks,), i8, ("tick",)),
            ArraySpec(
                "sensor/values",
                (s.readings, s.sensor_channels),
                np.dtype(sensor_dtype).newbyteorder("<"),
                ("sensor_reading", "channel"),
            ),
            ArraySpec("sensor/time", (s.readings,), f8, ("sensor_reading",)),
            ArraySpec("state/values", (s.states, s.state_dim), f4, ("state_reading", "state_dim")),
            ArraySpec("state/time", (s.states,), f8, ("state_reading",)),
            *(
                ArraySpec(f"episode/{kind}_start", (edge,), i8, ("episode_edge",))
                for kind in ("tick", "vl", "sensor", "state", "text")
            ),
            ArraySpec("episode/source", (s.episodes,), i4, ("episode",)),
            ArraySpec("episode/text", (s.text_bytes,), u1, ("byte",)),
        )
    }


ARRAY_NAMES = tuple(arrays(Sizes(0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0), "float32", "float32"))


def read_specs(root: Path) -> dict[str, ArraySpec]:
    """The arrays of a store or a build on disk, by name.

    Raises `StoreIncomplete` where one is missing.
    """
    return {name: read_spec(root, name) for name in ARRAY_NAMES}


def read_spec(root: Path, name: str) -> ArraySpec:
    """An array of a store or a build as its metadata on disk say.

    Raises `StoreIncomplete` where they are missing or cannot be read.
    """
    try:
        array = zarr.open_array(root, path=name, mode="r")
    except FileNotFoundError:
        raise StoreIncomplete(f"{root}: the array {name} is missing. {mend(root)}") from None
    except (ValueError, KeyError, TypeError) as error:
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
