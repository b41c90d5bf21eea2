"""The rows of a finished store, checked while they are read.

Plain reads, never a map: a disk that fails must be an error, not a SIGBUS. Nothing is opened for
writing, so that a read-only store will do.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import StoreIncomplete
from pipeline.store.archive.layout import rows_of
from pipeline.store.chunks import read_chunk
from pipeline.store.repair_hints import mend
from pipeline.store.schema import TRAILER_BYTES, ArraySpec, chunk_paths


def checked_rows(
    paths: Sequence[Path], spec: ArraySpec, chunks: range
) -> tuple[NDArray[Any], list[int]]:
    """The rows of consecutive chunk files, and the crc32c of the data of each file.

    Raises `StoreIncomplete` naming array, file and rows where a file does not give its trailer.
    """
    block = np.empty((len(chunks), spec.chunk_bytes), np.uint8)
    crcs: list[int] = []
    for data, chunk in zip(block, chunks, strict=True):
        rows_of_file = data.view(spec.dtype).reshape(-1, *spec.shape[1:])

        def keep(first: int, rows: NDArray[Any], into: NDArray[Any] = rows_of_file) -> None:
            into[first : first + len(rows)] = rows

        file = read_chunk(paths[chunk], spec, keep)
        if file.damage:
            bad = spec.chunk_rows_of(chunk)
            raise StoreIncomplete(
                f"{paths[chunk]}: rows {bad.start} to {bad.stop - 1} of {spec.name}: "
                f"{file.damage}. {mend(paths[chunk])}"
            )
        crcs.append(file.crc)
    rows, flat = len(rows_of(spec, chunks)), block.reshape(-1)
    used = rows * spec.row_bytes
    if flat[used:].any():
        raise StoreIncomplete(
            f"{paths[chunks[-1]]}: bytes other than 0 behind the last row of {spec.name}, which "
            "no build of this version leaves. Extract the store again with stages.extract."
        )
    return flat[:used].view(spec.dtype).reshape(rows, *spec.shape[1:]), crcs


def chunk_crcs(spec: ArraySpec, chunks: range, values: NDArray[Any]) -> list[int]:
    """The crc32c of the data of each of these chunk files; behind the last row are zeros."""
    crcs: list[int] = []
    for index in range(len(chunks)):
        data = values[index * spec.chunk_rows : (index + 1) * spec.chunk_rows]
        crc = google_crc32c.value(data.reshape(-1).view(np.uint8))
        crcs.append(google_crc32c.extend(crc, bytes(spec.chunk_bytes - data.nbytes)))
    return crcs


def all_rows(store: Path, spec: ArraySpec) -> NDArray[Any]:
    """Every row of a small array, checked."""
    chunks = range(spec.chunk_count)
    if not chunks:
        return np.zeros(spec.shape, spec.dtype)
    return checked_rows(chunk_paths(store, spec), spec, chunks)[0]


def samples(store: Path, spec: ArraySpec, rows: int, wanted: int) -> list[NDArray[Any]]:
    """Runs of up to `rows` rows, evenly spread over an array; not checked.

    A run is a multiple of 8 rows where there are as many, as every inner chunk is: Blosc leaves
    the bits of any other number of values unshuffled.
    """
    paths = chunk_paths(store, spec)
    last = (spec.shape[0] - 1) // rows
    found: list[NDArray[Any]] = []
    for block in np.unique(np.linspace(0, last, wanted).astype(int)).tolist():
        start = block * rows
        chunk, inside = divmod(start, spec.chunk_rows)
        left = min(rows, spec.shape[0] - start)
        taken = left // 8 * 8 or left
        values = np.fromfile(
            paths[chunk],
            spec.dtype,
            taken * spec.row_bytes // spec.dtype.itemsize,
            offset=inside * spec.row_bytes,
        )
        found.append(values.reshape(taken, *spec.shape[1:]))
    return found


def trailer(path: Path) -> int:
    """The checksum that stands at the end of a chunk file."""
    with path.open("rb") as file:
        file.seek(-TRAILER_BYTES, os.SEEK_END)
        return int.from_bytes(file.read(), "little")
