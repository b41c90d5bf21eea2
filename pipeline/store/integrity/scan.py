"""One pass over a chunk file: its size and trailer, and what its rows say.

With plain reads, never through a map: a file that ends early is a finding and not a SIGBUS.
"""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from numpy.typing import NDArray

from pipeline.errors import StoreIncomplete
from pipeline.store.chunks import ChunkFiles, row_checksums
from pipeline.store.schema import CHECKSUMS, FEATURES, TRAILER_BYTES, ArraySpec

_BLOCK_BYTES = 4 * 2**20
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
        pass_ = _Pass(self.path, spec)
        try:
            for first, values in pass_.blocks():
                start = rows.start + first
                kept = values[: max(0, rows.stop - start)]
                found = self._faults(start, kept) if len(kept) else {}  # else padding
                for what, bad in found.items():
                    if bad.any():
                        faults.setdefault(what, []).append(start + np.flatnonzero(bad))
        finally:
            pass_.close()
        unread = np.arange(min(rows.start + pass_.whole_rows, rows.stop), rows.stop)
        if len(unread):
            faults.setdefault(UNREADABLE, []).append(unread)
        found = {what: np.concatenate(each) for what, each in faults.items()}
        return ChunkReport(self.array, self.chunk, pass_.bytes, pass_.damage, found)

    def _faults(self, start: int, values: NDArray[Any]) -> dict[str, NDArray[np.bool_]]:
        """Which rows (row,) of a block are bad, by what is wrong."""
        if self.array == FEATURES:
            return self._feature_faults(start, values)
        if values.dtype.kind != "f":
            return {}
        if self.array == "vl/frame_time":  # NaN says that the episode lacks the view
            return {"an infinite time": _any_in_row(np.isinf(values))}
        return {NOT_FINITE: _any_in_row(not_finite(values, str(values.dtype)))}

    def _feature_faults(self, start: int, values: NDArray[Any]) -> dict[str, NDArray[np.bool_]]:
        spec = self.specs[FEATURES]
        bad = not_finite(values, spec.attributes.get("dtype", str(spec.dtype)))
        if bad.any():
            bad = _any_in_row(bad & (self._beside("vl/slot_valid", start, values) != 0)[..., None])
        faults = {NOT_FINITE: bad if bad.ndim == 1 else np.zeros(len(values), np.bool_)}
        try:
            stored = self._beside(CHECKSUMS, start, values)
        except StoreIncomplete:  # the file of checksums is a finding of its own
            return faults | {CHANGED: np.ones(len(values), np.bool_)}
        changed = stored != row_checksums(values)
        return faults | {UNWRITTEN: stored == 0, CHANGED: changed & (stored != 0)}

    def _beside(self, name: str, start: int, values: NDArray[Any]) -> NDArray[Any]:
        """The same rows of another array."""
        files = ChunkFiles(self.root, self.specs[name], writable=False)
        try:
            return files.read(start, len(values))
        finally:
            files.close()


class _Pass:
    """Blocks of whole rows of a chunk file, and at the end what is wrong with the file."""

    def __init__(self, path: Path, spec: ArraySpec) -> None:
        self.damage: str | None = None
        self.bytes = 0
        self.whole_rows = 0
        self._spec = spec
        self._descriptor: int | None = None
        try:
            self._descriptor = os.open(path, os.O_RDONLY)
        except OSError as error:
            self.damage = f"expected a chunk file, found none ({error.strerror})"

    def blocks(self) -> Iterator[tuple[int, NDArray[Any]]]:
        """(first row within the chunk, rows); the rows are valid until the next block."""
        if self._descriptor is None:
            return
        spec = self._spec
        together = max(1, min(spec.chunk_rows, _BLOCK_BYTES // spec.row_bytes))
        buffer, crc = np.empty(together * spec.row_bytes, np.uint8), 0
        for first in range(0, spec.chunk_rows, together):
            wanted = min(together, spec.chunk_rows - first) * spec.row_bytes
            got = self._read(buffer[:wanted], first * spec.row_bytes)
            whole = got // spec.row_bytes
            self.whole_rows += whole
            crc = google_crc32c.extend(crc, buffer[:got])
            values = buffer[: whole * spec.row_bytes].view(spec.dtype)
            yield first, values.reshape(whole, *spec.shape[1:])
            if got < wanted:
                break
        self._judge(crc)

    def close(self) -> None:
        """Close the file."""
        if self._descriptor is not None:
            os.close(self._descriptor)

    def _judge(self, crc: int) -> None:
        assert self._descriptor is not None
        if self.damage:
            return
        size, wanted = os.fstat(self._descriptor).st_size, self._spec.chunk_bytes + TRAILER_BYTES
        if size != wanted:
            self.damage = f"expected {wanted} bytes, found {size}"
            return
        trailer = np.zeros(TRAILER_BYTES, np.uint8)
        self._read(trailer, self._spec.chunk_bytes)
        stored = int.from_bytes(trailer.tobytes(), "little")
        if stored != crc and not self.damage:
            self.damage = f"expected the crc32c {stored:08x} of its trailer, found {crc:08x}"

    def _read(self, into: NDArray[np.uint8], offset: int) -> int:
        """Bytes read, fewer where the file ends or the disk fails."""
        assert self._descriptor is not None
        done = 0
        while done < len(into):
            try:
                got = os.preadv(self._descriptor, [into[done:].data], offset + done)
            except OSError as error:
                self.damage = f"cannot be read at byte {offset + done}: {error.strerror}"
                break
            if not got:
                break
            done += got
        self.bytes += done
        return done


def not_finite(values: NDArray[Any], dtype: str) -> NDArray[np.bool_]:
    """Where values are NaN or infinite, in their shape; `dtype` says what bits stand for."""
    if dtype not in _EXPONENTS:
        return ~np.isfinite(values)
    exponents = values.view(np.uint16) & _EXPONENTS[dtype]
    return exponents == _EXPONENTS[dtype]


def _any_in_row(bad: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.any(bad.reshape(len(bad), -1), axis=1) if bad.size else np.zeros(len(bad), np.bool_)
