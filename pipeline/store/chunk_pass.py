"""One pass over a chunk file: its rows, and whether the file is as it was written.

With plain reads, never through a map: a file that ends early is a finding and not a SIGBUS.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from numpy.typing import NDArray

from pipeline.store.schema import TRAILER_BYTES, ArraySpec

BLOCK_BYTES = 4 * 2**20
"""Read at a time: it is still in the processor's cache when it is checked."""


class ChunkPass:
    """Blocks of whole rows of a chunk file, and at the end what is wrong with the file."""

    def __init__(self, path: Path, spec: ArraySpec) -> None:
        self.damage: str | None = None
        """Expected and found; None as long as nothing is wrong with the file as a file."""
        self.bytes = 0
        """That were read."""
        self.whole_rows = 0
        """That lie in the file, those of padding among them."""
        self.crc = 0
        """The crc32c of the data that were read."""
        self._spec = spec
        self._descriptor: int | None = None
        try:
            self._descriptor = os.open(path, os.O_RDONLY)
        except OSError as error:
            self.damage = f"expected a chunk file, found none ({error.strerror})"

    @property
    def complete(self) -> bool:
        """Whether all rows were read, whatever stands behind them."""
        return self.whole_rows == self._spec.chunk_rows

    def blocks(self, buffer: NDArray[np.uint8] | None = None) -> Iterator[tuple[int, NDArray[Any]]]:
        """(first row within the chunk, rows); the rows are valid until the next block.

        As many at a time as fit into `buffer` (byte,), where one is given.
        """
        if self._descriptor is None:
            return
        spec = self._spec
        room = BLOCK_BYTES if buffer is None else buffer.nbytes
        together = max(1, min(spec.chunk_rows, room // spec.row_bytes))
        if buffer is None:
            buffer = np.empty(together * spec.row_bytes, np.uint8)
        for first in range(0, spec.chunk_rows, together):
            wanted = min(together, spec.chunk_rows - first) * spec.row_bytes
            got = self._read(buffer[:wanted], first * spec.row_bytes)
            whole = got // spec.row_bytes
            self.whole_rows += whole
            self.crc = google_crc32c.extend(self.crc, buffer[:got])
            values = buffer[: whole * spec.row_bytes].view(spec.dtype)
            yield first, values.reshape(whole, *spec.shape[1:])
            if got < wanted:
                break
        self._judge()

    def close(self) -> None:
        """Close the file."""
        if self._descriptor is not None:
            os.close(self._descriptor)

    def _judge(self) -> None:
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
        if stored != self.crc and not self.damage:
            self.damage = f"expected the crc32c {stored:08x} of its trailer, found {self.crc:08x}"

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
