"""Lossless codecs for an archive, and the choice among them by measuring on the array itself.

Blosc is given the whole inner chunk as one block: in blocks of its own choice, features take a
tenth more (`python -m benchmarks.compression`). A transpose stores each channel of a chunk for
itself, so that neighbours in time are neighbours in the file. numcodecs' Shuffle before Zstd gives
what Blosc gives in one block and is left out, for zarr v3 has no such codec; its Delta after a
transpose does not give the bits back, and its PackBits takes booleans, which a store has none of.
"""

import time
import warnings
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, BloscShuffle, Crc32cCodec, TransposeCodec
from zarr.codecs.numcodecs import Delta
from zarr.core.buffer import Buffer
from zarr.errors import ZarrUserWarning
from zarr.storage import MemoryStore

_CLOSE = 1.01
"""A simpler codec is taken where the best one saves less than this."""


@dataclass(frozen=True)
class Codec:
    """One way to store an inner chunk without loss."""

    name: str
    filters: tuple[Any, ...] = ()
    compressors: tuple[Any, ...] = ()
    standard: bool = True
    """Whether every implementation of zarr v3 has it, or zarr-python alone."""


@dataclass(frozen=True)
class Measured:
    """What one codec makes of one inner chunk."""

    raw_bytes: int
    stored_bytes: int
    compress_s: float
    decompress_s: float
    exact: bool
    """Whether what comes back is the same to the bit."""


@dataclass(frozen=True)
class Choice:
    """The codec of an array and how well each candidate compressed its samples."""

    codec: Codec
    ratios: Mapping[str, float | None]
    """Raw bytes / stored bytes by name; None for one that did not give the bits back."""


def blosc_level(zstd_level: int) -> int:
    """The Blosc level that stands for a level of zstd, or for the next lower it can name.

    Blosc numbers its levels 1 to 9 and runs zstd at 1, 3, 5, …, 15 and 22 for them (c-blosc,
    `zstd_wrap_compress`).
    """
    return 9 if zstd_level >= 22 else min(8, (zstd_level + 1) // 2)


def codecs_for(dtype: np.dtype[Any], ndim: int, chunk_bytes: int, level: int) -> list[Codec]:
    """The candidates for an array of inner chunks of `chunk_bytes`, simplest first.

    `level` is zstd's, 1 to 22.
    """

    def blosc(shuffle: BloscShuffle) -> BloscCodec:
        return BloscCodec(
            cname="zstd", clevel=blosc_level(level), shuffle=shuffle, blocksize=chunk_bytes
        )

    plain = blosc(BloscShuffle.noshuffle)
    shuffles = [(shuffle.value, blosc(shuffle)) for shuffle in _shuffles(dtype)]
    found = [Codec("none"), Codec("zstd", (), (plain,))]
    found += [Codec(name, (), (compressor,)) for name, compressor in shuffles]
    if ndim > 1:
        last_first = TransposeCodec(order=(*range(1, ndim), 0))
        found += [
            Codec(f"transpose+{name}", (last_first,), (compressor,))
            for name, compressor in (("zstd", plain), *shuffles)
        ]
    if dtype.kind in "iu" and dtype.itemsize > 1:
        with outside_the_specification():
            delta = Delta(dtype=dtype.str)
        found += [
            Codec(f"delta+{name}", (delta,), (compressor,), standard=False)
            for name, compressor in shuffles
        ]
    return found


def checked(compressors: Sequence[Any]) -> list[Any]:
    """The compressors with a checksum of what they give behind it."""
    return [*compressors, Crc32cCodec()]


@contextmanager
def outside_the_specification() -> Generator[None]:
    """Silence what zarr says of every numcodecs filter, and nothing else.

    The warning is true and already acted upon: such a filter is chosen only where it is worth
    that zarr-python alone can read the array (`choose`).
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Numcodecs codecs are not in the Zarr", ZarrUserWarning)
        yield


def measure(codec: Codec, block: NDArray[Any]) -> Measured:
    """Store a block as zarr would store it as an inner chunk, and read it back."""
    stored: dict[str, Buffer] = {}
    begun = time.perf_counter()
    with outside_the_specification():
        array = zarr.create_array(
            MemoryStore(stored),
            shape=block.shape,
            chunks=block.shape,
            dtype=block.dtype,
            filters=list(codec.filters),
            compressors=checked(codec.compressors),
            fill_value=0,
            config={"write_empty_chunks": True},
        )
    array[...] = block
    written = time.perf_counter()
    back = np.ascontiguousarray(array[...])
    read = time.perf_counter()
    return Measured(
        raw_bytes=block.nbytes,
        stored_bytes=sum(len(value) for name, value in stored.items() if name != "zarr.json"),
        compress_s=written - begun,
        decompress_s=read - written,
        exact=np.array_equal(_bits(back), _bits(np.ascontiguousarray(block))),
    )


def choose(samples: Sequence[NDArray[Any]], codecs: Sequence[Codec], worth: float) -> Choice:
    """The codec that stores the samples in the fewest bytes, of those that give back every bit.

    The first of those within one per cent of the best is taken. A codec outside of zarr's
    specification must save at least the share `worth` of the raw bytes more than the best within.
    """
    raw = sum(sample.nbytes for sample in samples)
    stored = {codec.name: _stored_bytes(codec, samples) for codec in codecs}

    def smallest(standard: bool) -> tuple[float, Codec] | None:
        sizes = [
            (size, codec)
            for codec in codecs
            if codec.standard is standard and (size := stored[codec.name]) is not None
        ]
        least = min((size for size, _ in sizes), default=0)
        return next((pair for pair in sizes if pair[0] <= least * _CLOSE), None)

    within, outside = smallest(standard=True), smallest(standard=False)
    assert within is not None, "to store the bytes as they are is always exact"
    best = within[1]
    if outside is not None and within[0] - outside[0] >= worth * raw:
        best = outside[1]
    ratios = {name: None if size is None else raw / size for name, size in stored.items()}
    return Choice(best, ratios)


def _stored_bytes(codec: Codec, samples: Sequence[NDArray[Any]]) -> int | None:
    """Bytes that the samples take; None where one does not come back as it was."""
    total = 0
    for sample in samples:
        found = measure(codec, sample)
        if not found.exact:
            return None
        total += found.stored_bytes
    return total


def _shuffles(dtype: np.dtype[Any]) -> list[BloscShuffle]:
    """Bytes can only be shuffled where there is more than one to a number."""
    return [BloscShuffle.shuffle] * (dtype.itemsize > 1) + [BloscShuffle.bitshuffle]


def _bits(values: NDArray[Any]) -> NDArray[np.uint8]:
    return values.reshape(-1).view(np.uint8)
