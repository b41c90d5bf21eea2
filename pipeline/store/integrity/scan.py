"""What a chunk file and its rows say, read once."""

from collections import defaultdict
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import StoreIncomplete
from pipeline.base.finite import non_finite
from pipeline.store.chunks import ChunkFiles, ChunkPass, read_rows, row_checksums
from pipeline.store.schema import CHECKSUMS, FEATURES, ArraySpec, chunk_paths

UNREADABLE = "not in its file"
UNWRITTEN = "was never written (its checksum is 0)"
CHANGED = "its bytes do not give its checksum"
NOT_FINITE = "NaN or infinity"


@dataclass(frozen=True)
class ChunkReport:
    """How one chunk file is."""

    array: str
    chunk: int
    path: Path
    bytes: int
    """That were read."""
    rows: int
    """That could be read, those of padding left out."""
    damage: str | None
    """What is wrong with the file as a file."""
    faults: Mapping[str, NDArray[np.int64]]
    """Feature rows that cannot be used, by what is wrong with them."""


def judge_rows(
    features: NDArray[Any], checksums: NDArray[np.uint32], slot_valid: NDArray[np.uint8]
) -> dict[str, NDArray[np.bool_]]:
    """Which feature rows (row, slot, dim) cannot be used, (row,) each, by what is wrong.

    `checksums` (row,) and `slot_valid` (row, slot) are as the store holds them: a NaN in a slot
    that is not valid is nobody's.
    """
    broken = non_finite(features).any(axis=2) & (slot_valid != 0)
    changed = checksums != row_checksums(features)
    return {
        NOT_FINITE: broken.any(axis=1),
        UNWRITTEN: checksums == 0,
        CHANGED: changed & (checksums != 0),
    }


def check_chunk(root: Path, specs: Mapping[str, ArraySpec], array: str, chunk: int) -> ChunkReport:
    """Read a chunk file once, in blocks; runs in any process that sees the store."""
    spec, path = specs[array], chunk_paths(root, specs[array])[chunk]
    rows, faults = spec.chunk_rows_of(chunk), defaultdict[str, list[NDArray[np.int64]]](list)
    with closing(ChunkPass(path, spec)) as file:
        for first, block in file.blocks():
            start = rows.start + first
            values = block[: max(0, rows.stop - start)]  # the rest is padding
            if array == FEATURES and len(values):
                beside = (_beside(root, specs, name, start, values) for name in _BESIDE)
                for what, bad in judge_rows(values, *beside).items():
                    faults[what].append(start + np.flatnonzero(bad))
    read = min(file.whole_rows, len(rows))
    if array == FEATURES:
        faults[UNREADABLE].append(np.arange(rows.start + read, rows.stop))
        if file.damage is None and _checksums_are_damaged(root, specs, rows):
            del faults[CHANGED], faults[UNWRITTEN]
    joined = {what: np.concatenate(parts) for what, parts in faults.items()}
    found = {what: bad for what, bad in joined.items() if len(bad)}
    return ChunkReport(array, chunk, path, file.bytes, read, file.damage, found)


_BESIDE = (CHECKSUMS, "vl/slot_valid")
"""What feature rows are judged by."""


def _beside(
    root: Path, specs: Mapping[str, ArraySpec], name: str, start: int, features: NDArray[Any]
) -> NDArray[Any]:
    """The same rows of another array; ones where that cannot be read, as is said of its file."""
    try:
        return read_rows(root, specs[name], start, start + len(features))
    except (KeyError, StoreIncomplete):
        return np.ones(features.shape[: 1 if name == CHECKSUMS else 2], np.uint8)


def _checksums_are_damaged(root: Path, specs: Mapping[str, ArraySpec], rows: range) -> bool:
    """Whether the checksums of these rows are lost: then those of a sound file are good."""
    if CHECKSUMS not in specs:
        return True
    with closing(ChunkFiles(root, specs[CHECKSUMS], writable=False)) as files:
        chunks = {row // files.spec.chunk_rows for row in (rows.start, rows.stop - 1)}
        return any(files.damage(chunk) for chunk in chunks)
