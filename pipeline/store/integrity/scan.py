"""What a chunk file and its rows say, read once."""

from collections.abc import Mapping
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import StoreIncomplete
from pipeline.store.chunk_pass import ChunkPass
from pipeline.store.chunks import ChunkFiles, row_checksums
from pipeline.store.schema import CHECKSUMS, FEATURES, TRAILER_BYTES, ArraySpec

_EXPONENTS = {"bfloat16": np.uint16(0x7F80), "float16": np.uint16(0x7C00)}
"""The bits that are all set in a NaN or an infinity, and in no number: numpy knows no bfloat16,
and is slow with float16."""

UNREADABLE = "not in its file"
UNWRITTEN = "was never written (its checksum is 0)"
CHANGED = "its bytes do not give its checksum"
NOT_FINITE = "NaN or infinity"


@dataclass(frozen=True)
class ChunkReport:
    """What was found in one chunk file."""

    array: str
    chunk: int
    bytes: int
    damage: str | None = None
    """What is wrong with the file as a file."""
    faults: Mapping[str, NDArray[np.int64]] = field(default_factory=dict[str, NDArray[np.int64]])
    """Rows by what is wrong with them."""
    rows: int = 0
    """That could be read, those of padding left out."""


@dataclass(frozen=True)
class ChunkTask:
    """Read one chunk file once, in blocks, and check it; runs in any process that sees it."""

    root: Path
    specs: Mapping[str, ArraySpec]
    array: str
    chunk: int
    path: Path

    @property
    def bytes(self) -> int:
        """That it reads."""
        return self.specs[self.array].chunk_bytes + TRAILER_BYTES

    def __call__(self) -> ChunkReport:
        """Check the file and its rows."""
        spec = self.specs[self.array]
        rows = spec.chunk_rows_of(self.chunk)
        faults: dict[str, list[NDArray[np.int64]]] = {}
        with ExitStack() as stack:
            file = stack.enter_context(closing(ChunkPass(self.path, spec)))
            beside = {
                name: stack.enter_context(closing(ChunkFiles(self.root, other, writable=False)))
                for name, other in self.specs.items()
                if name != self.array
            }
            for first, values in file.blocks():
                start = rows.start + first
                kept = values[: max(0, rows.stop - start)]
                found = self._faults(start, kept, beside) if len(kept) else {}  # else padding
                for what, bad in found.items():
                    if bad.any():
                        faults.setdefault(what, []).append(start + np.flatnonzero(bad))
        read = min(file.whole_rows, len(rows))
        unread = np.arange(rows.start + read, rows.stop)
        if len(unread):
            faults.setdefault(UNREADABLE, []).append(unread)
        found = {what: np.concatenate(each) for what, each in faults.items()}
        return ChunkReport(self.array, self.chunk, file.bytes, file.damage, found, read)

    def _faults(
        self, start: int, values: NDArray[Any], beside: Mapping[str, ChunkFiles]
    ) -> dict[str, NDArray[np.bool_]]:
        """Which rows (row,) of a block are bad, by what is wrong."""
        if self.array == FEATURES:
            return self._feature_faults(start, values, beside)
        if values.dtype.kind != "f":
            return {}
        if self.array == "vl/frame_time":  # NaN says that the episode lacks the view
            return {"an infinite time": _any_in_row(np.isinf(values))}
        return {NOT_FINITE: _any_in_row(not_finite(values, str(values.dtype)))}

    def _feature_faults(
        self, start: int, values: NDArray[Any], beside: Mapping[str, ChunkFiles]
    ) -> dict[str, NDArray[np.bool_]]:
        spec = self.specs[FEATURES]
        bad = not_finite(values, spec.attributes.get("dtype", str(spec.dtype)))
        if bad.any():
            with suppress(StoreIncomplete):  # the file of slots is a finding of its own
                valid = beside["vl/slot_valid"].read(start, len(values))
                bad &= (valid != 0)[..., None]
        faults = {NOT_FINITE: _any_in_row(bad)}
        try:
            stored = beside[CHECKSUMS].read(start, len(values))
        except StoreIncomplete:  # so is the file of checksums
            return faults | {CHANGED: np.ones(len(values), np.bool_)}
        changed = stored != row_checksums(values)
        return faults | {UNWRITTEN: stored == 0, CHANGED: changed & (stored != 0)}


def not_finite(values: NDArray[Any], dtype: str) -> NDArray[np.bool_]:
    """Where values are NaN or infinite, in their shape; `dtype` says what bits stand for."""
    if dtype not in _EXPONENTS:
        return ~np.isfinite(values)
    exponents = values.view(np.uint16) & _EXPONENTS[dtype]
    return exponents == _EXPONENTS[dtype]


def _any_in_row(bad: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.any(bad.reshape(len(bad), -1), axis=1) if bad.size else np.zeros(len(bad), np.bool_)
