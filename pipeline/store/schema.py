"""What a store holds: its arrays, their dtypes and shapes, and how they lie in files.

Every array is a plain zarr v3 array without compression, chunked along its first axis only, by a
multiple of 4,096 rows; features, whose rows may take megabytes, by as few rows as fill whole pages.
So the data of a chunk file begin at byte 0 and fill whole pages for any row width, and a 4-byte
crc32c follows them. The file is both a zarr chunk and a flat block that can be mapped.
"""

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zarr
from zarr.codecs import BytesCodec, Crc32cCodec

from pipeline.base.arrays import packed_dim, packed_size
from pipeline.base.differences import differences
from pipeline.base.documents import Border, shown
from pipeline.base.projection import group_sizes
from pipeline.base.provenance import Spec
from pipeline.store.documents import ArrayDocument, StoreAttributes, store_border

SCHEMA = 2
READABLE = (1, 2)
"""In 1, chunks of features have a multiple of 4,096 rows too."""
ROW_MULTIPLE = 4096
_PAGES = (2**16, 2**12)
"""Bytes of a page: those of the largest, where a chunk then has at most `CHUNK_BYTES`."""
CHUNK_BYTES = 64 * 2**20
TRAILER_BYTES = 4
KEY_BYTES = 16
_MOST_CHUNK_BYTES = 2 * CHUNK_BYTES
MOST_ROW_BYTES = 2**26

FEATURES, KEYS, CHECKSUMS = "vl/features", "vl/key", "vl/checksum"
BASIS = "vl/basis"
"""The basis of projected features (`pipeline.base.projection`); other stores have none."""
INCREMENTAL = (FEATURES, KEYS, CHECKSUMS)
"""The arrays written row by row while the model works; all others are known beforehand."""


@dataclass(frozen=True)
class StoredStream:
    """A stream: the rows of the arrays `<stream>/…`, of which each episode has a range.

    `episode/<stream>_start` holds the start of each episode's range.
    """

    rows: str
    """The field of `Episode` with its range."""
    row: str
    """The word for one row in messages."""
    counted_by: str = ""
    """The array with each tick's position among these rows."""


STREAMS = {
    "tick": StoredStream("ticks", "tick"),
    "vl": StoredStream("vl_rows", "VL row", "tick/vl_row"),
    "sensor": StoredStream("readings", "sensor reading", "tick/sensor_end"),
    "state": StoredStream("states", "state reading", "tick/state_end"),
}


POSITIONS = {stored.counted_by: stream for stream, stored in STREAMS.items() if stored.counted_by}
"""Array of positions that ticks hold -> the stream whose rows they count."""


@dataclass(frozen=True)
class ArraySpec:
    """One array of a store: its name, shape and dtype."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    stored_chunk_rows: int | None = None
    """Rows per chunk of an array on disk; None for an array that follows the rule."""

    @property
    def dimensions(self) -> tuple[str, ...]:
        """The names of its axes."""
        return tuple(axis.removeprefix("key_") for axis in _ARRAYS[self.name][1:])

    @property
    def stored_dtype(self) -> str:
        """The name of its number type, which may have another dtype in numpy."""
        return self.attributes.get("dtype", self.dtype.name)

    @property
    def attributes(self) -> dict[str, Any]:
        """The attributes of the zarr array."""
        return _ENCODED.get(self.dtype.name, {}) if self.name == FEATURES else {}

    @property
    def row_bytes(self) -> int:
        """Bytes of one row."""
        return math.prod(self.shape[1:]) * self.dtype.itemsize

    @property
    def data_bytes(self) -> int:
        """Bytes of all rows, without padding and trailers."""
        return self.shape[0] * self.row_bytes

    @property
    def row_multiple(self) -> int:
        """Rows of which a chunk has a multiple, so that it fills whole pages."""
        if self.name not in (FEATURES, BASIS) or not self.row_bytes:
            return ROW_MULTIPLE
        multiples = [page // math.gcd(page, self.row_bytes) for page in _PAGES]
        fitting = (rows for rows in multiples if rows * self.row_bytes <= CHUNK_BYTES)
        return next(fitting, multiples[-1])

    @property
    def chunk_rows(self) -> int:
        """Rows per chunk: about 64 MB for wide rows; a small array is one chunk."""
        if self.stored_chunk_rows is not None:
            return self.stored_chunk_rows
        multiple = self.row_multiple
        wide = max(1, CHUNK_BYTES // (max(1, self.row_bytes) * multiple)) * multiple
        return min(wide, max(1, math.ceil(self.shape[0] / multiple)) * multiple)

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

    @property
    def document(self) -> dict[str, Any]:
        """The `zarr.json` that `create` writes in a store."""
        endian = {"configuration": {"endian": "little"}} if self.dtype.itemsize > 1 else {}
        chunk_shape = [self.chunk_rows, *(max(1, size) for size in self.shape[1:])]
        return {
            "zarr_format": 3,
            "node_type": "array",
            "shape": [*self.shape],
            "data_type": self.dtype.name,
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk_shape}},
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "codecs": [{"name": "bytes", **endian}, {"name": "crc32c"}],
            "fill_value": 0,
            "dimension_names": [*self.dimensions],
            "attributes": self.attributes,
            "storage_transformers": [],
        }

    def create(self, root: Path | dict[str, Any], **otherwise: Any) -> "zarr.Array[Any]":
        """Write the array's zarr metadata below `root`; an archive passes its chunks and codecs."""
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
            attributes=self.attributes,
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
    """The length of each axis of a store's arrays; a stream of width 0 is absent."""

    episode: int
    tick: int
    vl_row: int
    sensor_reading: int
    state_reading: int
    byte: int
    """Bytes of the texts of all episodes."""
    slot: int
    """Slots of a VL row, of all its variants, one variant after the other."""
    dim: int
    view: int
    action_dim: int
    channel: int
    """Channels of the sensor."""
    state_dim: int
    group: int = 0
    """Groups of slots that are projected, each with a map of its own."""
    input: int = 0
    """Inputs of a map: the model's channels, and 1."""


_ARRAYS = {
    FEATURES: ("", "vl_row", "slot", "dim"),
    "vl/slot_valid": ("u1", "vl_row", "slot"),
    "vl/time": ("f8", "vl_row"),
    "vl/frame_time": ("f8", "vl_row", "view"),
    KEYS: ("u1", "vl_row", "key_byte"),
    CHECKSUMS: ("u4", "vl_row"),
    BASIS: ("f4", "group", "input", "rank"),
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
"""Every array in the order of the contract: its type ("" where a param sets it), then its axes."""
ARRAY_NAMES = tuple(name for name in _ARRAYS if name != BASIS)
"""The arrays that every store has."""
GROUPS = tuple(sorted({name.partition("/")[0] for name in ARRAY_NAMES}))


_ENCODED: dict[str, dict[str, Any]] = {
    "uint16": {"dtype": "bfloat16"},
    "int8": {"dtype": "int8", "scales": "bfloat16 behind the codes, one for each 32"},
    "uint8": {"dtype": "float8", "scales": "bfloat16 behind the codes (e4m3fn), one for all"},
}
"""What an array of features of a numpy dtype holds, besides plain numbers."""
_HOLDS = {"bfloat16": "u2", "float8": "u1", "int8": "i1"}


def arrays(sizes: Sizes, features_dtype: str, sensor_dtype: str) -> dict[str, ArraySpec]:
    """Every array of a store, by name, in the order of the contract."""
    lengths = {**vars(sizes), "episode_edge": sizes.episode + 1, "key_byte": KEY_BYTES}
    lengths["rank"] = sizes.dim
    lengths["dim"] = packed_size(features_dtype, sizes.dim)
    chosen = {FEATURES: _HOLDS.get(features_dtype, features_dtype), "sensor/values": sensor_dtype}
    specs: dict[str, ArraySpec] = {}
    for name in (*ARRAY_NAMES, *([BASIS] if sizes.group else [])):
        code, *axes = _ARRAYS[name]
        dtype = np.dtype(code or chosen[name]).newbyteorder("<")
        specs[name] = ArraySpec(name, tuple(lengths[axis] for axis in axes), dtype)
    return specs


def read_specs(root: Path) -> dict[str, ArraySpec]:
    """The arrays of a store or a build on disk, by name, as `read_spec` reads them."""
    return {name: read_spec(root, name) for name in array_names(root)}


def array_names(root: Path) -> tuple[str, ...]:
    """The names of the arrays of a store or a build on disk."""
    return (*ARRAY_NAMES, *([BASIS] if (root / BASIS / "zarr.json").exists() else []))


def read_spec(root: Path, name: str) -> ArraySpec:
    """An array of a store or a build, from its metadata on disk.

    Raises `StoreIncomplete` where they cannot be read or do not follow the contract.
    """
    path, border = root / name / "zarr.json", store_border(root)
    spec = array_of(border.read_json(path, dict[str, Any]), name, path, border)
    if spec.chunk_count > _FEW:  # a false shape can claim a huge number
        folder = root / name / "c"
        present = len(os.listdir(folder)) if folder.is_dir() else 0
        if spec.chunk_count > _FEW + 2 * present:
            what = f"expected {spec.chunk_count:,} chunk files by the shape, found {present:,}"
            raise border.refusal(path, what)
    return spec


_FEW = 64
"""Up to this many chunk files, an array's folder is not counted here."""
_MOST_SHOWN = 5
_CHOSEN = {
    FEATURES: ("float32", "float16", *_ENCODED),
    "sensor/values": ("float32", "float16"),
}
"""The allowed types of arrays whose type a param sets."""


def array_of(document: dict[str, Any], name: str, where: Path | str, border: Border) -> ArraySpec:
    """The array that the metadata describe; refused where they do not follow the contract."""
    array = border.parse(document, ArrayDocument, where)
    code, *axes = _ARRAYS[name]
    if len(array.shape) != len(axes):
        raise border.refusal(where, f"expected the axes {axes}, found the shape {array.shape}")
    allowed = _CHOSEN.get(name) or (np.dtype(code).name,)
    dtype = array.data_type if array.data_type in allowed else allowed[0]
    spec = ArraySpec(name, tuple(array.shape), np.dtype(dtype).newbyteorder("<"))
    if spec.row_bytes > MOST_ROW_BYTES:
        what = f"expected rows of at most {MOST_ROW_BYTES:,} bytes, found the shape {array.shape}"
        raise border.refusal(where, what)
    rows = array.chunk_rows
    whole = max(1, math.ceil(spec.shape[0] / ROW_MULTIPLE)) * ROW_MULTIPLE
    most = max(ROW_MULTIPLE, _MOST_CHUNK_BYTES // max(1, spec.row_bytes))
    if 0 < rows <= min(whole, most) and (rows % ROW_MULTIPLE) % spec.row_multiple == 0:
        spec = replace(spec, stored_chunk_rows=rows)
    if document != spec.document:
        first = [*differences(spec.document, document).items()][:_MOST_SHOWN]
        lines = [f"expected the {key} {a}, found {shown(b)}" for key, (a, b) in first]
        raise border.refusal(where, "; ".join(lines))
    return spec


def disagreements(specs: Mapping[str, ArraySpec]) -> Iterator[tuple[str, str]]:
    """The arrays whose length along an axis differs from that of the others, and how.

    Arrays are read in reverse order, and the first array on an axis sets its length.
    """
    lengths = {"key_byte": KEY_BYTES}
    for name in [name for name in reversed(ARRAY_NAMES) if name in specs]:
        for axis, length in zip(_ARRAYS[name][1:], specs[name].shape, strict=True):
            edge = axis == "episode_edge"
            wanted = lengths.setdefault("episode" if edge else axis, length - edge) + edge
            if length != wanted:
                yield name, f"expected the shape to have {wanted} along {axis}, found {length}"
                break


def rows_of(specs: Mapping[str, ArraySpec]) -> dict[str, int]:
    """The rows of each stream, and the bytes of all texts."""
    rows = {stream: specs[f"{stream}/time"].shape[0] for stream in STREAMS}
    return rows | {"text": specs["episode/text"].shape[0]}


def check_agreement(
    root: Path, attrs: StoreAttributes, specs: Mapping[str, ArraySpec], border: Border | None = None
) -> None:
    """Raise `StoreIncomplete` where a store's arrays do not fit each other or its attributes."""
    border = border or store_border(root)
    for name, what in disagreements(specs):
        raise border.refusal(root / name / "zarr.json", what)
    streams, spec = attrs.streams, attrs.feature_spec
    pairs = {
        "streams.action.names": (streams.action.names, specs["tick/action"].shape[1]),
        "streams.sensor.names": (streams.sensor.names, specs["sensor/values"].shape[1]),
        "streams.state.names": (streams.state.names, specs["state/values"].shape[1]),
        "streams.views": (streams.views, specs["vl/frame_time"].shape[1]),
        "feature_spec.slots": (spec.slots, specs[FEATURES].shape[1]),
    }
    wrong = [f"{at}: expected {n}, found {len(k)}" for at, (k, n) in pairs.items() if len(k) != n]
    if len(spec.slots) % spec.variants:
        wrong.append(f"feature_spec.variants: expected a divisor of {len(spec.slots)} slots")
    held = specs[FEATURES]
    dim = packed_dim(held.stored_dtype, held.shape[2])
    if spec.dim not in (None, dim):
        wrong.append(f"feature_spec.dim: expected {dim}, which {FEATURES} holds, found {spec.dim}")
    basis = BASIS in specs and specs[BASIS].shape
    if basis != (expected := _basis_shape(spec)):
        wrong.append(f"feature_spec.pca: expected the array {BASIS} {expected}, found {basis}")
    rows = specs[FEATURES].shape[0]
    wrong += [f"golden: row {row.row} of {rows}" for row in attrs.golden if row.row >= rows]
    if wrong:
        raise border.refusal(root / "zarr.json", "; ".join(wrong))


def _basis_shape(spec: Spec) -> tuple[int, ...] | Literal[False]:
    """The shape of the basis of this spec's features; False without one."""
    if spec.pca is None:
        return False
    groups = group_sizes([slot.model_dump() for slot in spec.slots])
    return len(groups), spec.pca.of + 1, spec.dim or 0
