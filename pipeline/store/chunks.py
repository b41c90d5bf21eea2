"""The chunk files of one array, written and read by row with plain system calls.

A memory map is not used here: through a map, a full disk or a file that ends early would be a
SIGBUS, but here both must be errors.
"""

import errno
import hashlib
import json
import os
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import zarr
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.documents import shown
from pipeline.base.errors import StoreIncomplete
from pipeline.base.files import disk_full_named
from pipeline.store.documents import mend, store_border
from pipeline.store.paths import group_attributes, laid_out_attributes
from pipeline.store.schema import (
    CHECKSUMS,
    FEATURES,
    GROUPS,
    INCREMENTAL,
    TRAILER_BYTES,
    ArraySpec,
    array_names,
    chunk_path,
    chunk_paths,
    read_spec,
    read_specs,
)

METADATA_DIGEST = "metadata_digest"
"""The root's attribute with the digest of all metadata, because an attribute has no checksum.

It covers the `zarr.json` of the root (without the digest itself), of each group and of each array,
as JSON with sorted keys. With the seal in the root, this one digest covers everything in the store.
"""
SEAL = "seal"
"""The root's attribute with the trailers of each array's chunk files, in order, in hex."""
Seal = Mapping[str, str]
"""The value of `SEAL`: array -> hex digits."""
UNSEALED = "expected a seal over metadata and chunks, found none: an earlier version wrote it"
BLOCK_BYTES = 4 * 2**20
"""Bytes read at a time; few enough to be still in the processor's cache when they are checked."""
_MOST_OPEN = 32
_THREADS = 4


def row_checksums(rows: NDArray[Any]) -> NDArray[np.uint32]:
    """The crc32c of each row's bytes, (row,); a true 0 becomes 1, because 0 means "not written"."""
    flat = np.ascontiguousarray(rows).reshape(len(rows), -1).view(np.uint8)
    sums = np.fromiter((google_crc32c.value(row) for row in flat), np.uint32, len(flat))
    return np.where(sums == 0, np.uint32(1), sums)


def check_row_checksums(
    store: Path,
    spec: ArraySpec,
    rows: NDArray[np.int64] | range,
    features: NDArray[Any],
    wanted: NDArray[np.uint32],
) -> None:
    """Raise `StoreIncomplete` where these feature rows do not give these checksums."""
    bad = np.asarray(rows)[row_checksums(features) != wanted]
    if bad.size:
        path = chunk_path(store, spec, bad[0] // spec.chunk_rows)
        what = f"{_wrong_rows(spec, bad.tolist())}: the store is damaged"
        raise store_border(store).refusal(path, what)


def note_metadata(root: Path, attributes: Mapping[str, Any] | None = None) -> None:
    """Write the digest into the root, with these attributes or else those that it has."""
    kept = group_attributes(root) if attributes is None else attributes
    digest = _metadata_digest(root, kept)
    zarr.open_group(root, mode="r+").attrs.put({**kept, METADATA_DIGEST: digest})


def check_metadata(root: Path) -> None:
    """Raise `StoreIncomplete` where the metadata cannot be read or do not give their digest."""
    attributes = group_attributes(root)
    stored, actual = attributes.get(METADATA_DIGEST), _metadata_digest(root, attributes)
    if stored != actual:
        what = f"the metadata were changed: expected their digest {shown(stored)}, found {actual}"
        raise store_border(root).refusal(root / "zarr.json", what)


def _metadata_digest(root: Path, attributes: Mapping[str, Any]) -> str:
    """The digest of the metadata on disk, with these root attributes."""
    places, border = ("", *GROUPS, *array_names(root)), store_border(root)
    documents = {at: border.read_json(root / at / "zarr.json", dict[str, Any]) for at in places}
    kept = {name: value for name, value in attributes.items() if name != METADATA_DIGEST}
    documents[""]["attributes"] = kept
    text = json.dumps(documents, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def trailers(root: Path, spec: ArraySpec) -> bytes:
    """The trailers of an array's chunk files, in order; reads no other byte.

    Raises `StoreIncomplete` where a file is missing or has the wrong size.
    """
    border, wanted, read = store_border(root), spec.chunk_bytes + TRAILER_BYTES, b""
    for path in chunk_paths(root, spec):
        if (actual := border.check_file(path)) != wanted:
            raise border.refusal(path, f"expected {wanted:,} bytes, found {actual:,}")
        with path.open("rb", buffering=0) as file:
            read += os.pread(file.fileno(), TRAILER_BYTES, spec.chunk_bytes)
    return read


def write_seal(root: Path, **attributes: Any) -> None:
    """Write the seal of a complete store, and these attributes, into its root."""
    seal = {name: trailers(root, spec).hex() for name, spec in read_specs(root).items()}
    note_metadata(root, {**group_attributes(root), **attributes, SEAL: seal})


def check_seal(root: Path, seal: Seal | None, specs: Mapping[str, ArraySpec]) -> None:
    """Raise `StoreIncomplete` where metadata or a chunk file differ from what was sealed.

    A chunk file may be changed, or come from another place, another store or an older copy. Reads
    only metadata and trailers; `check_trailers` also proves that each chunk gives its trailer.
    """
    border = store_border(root)
    if seal is None:
        raise border.refusal(root / "zarr.json", UNSEALED)
    check_metadata(root)
    for name, spec in specs.items():
        present = trailers(root, spec)
        for chunk, path in enumerate(chunk_paths(root, spec)):
            trailer = present[chunk * TRAILER_BYTES :][:TRAILER_BYTES]
            if what := _unsealed(trailer, sealed_trailer(seal, name, chunk)):
                raise border.refusal(path, what)


def sealed_trailer(seal: Seal | None, array: str, chunk: int) -> bytes | None:
    """The sealed trailer of a chunk file; None where nothing is sealed yet."""
    digits = 2 * TRAILER_BYTES
    return None if seal is None else bytes.fromhex(seal.get(array, "")[chunk * digits :][:digits])


def _unsealed(crc: bytes, sealed: bytes | None) -> str | None:
    """What is wrong with a chunk file if its checksum `crc` is not the sealed one; else None."""
    if sealed in (None, crc):
        return None
    return (
        f"expected the crc32c {sealed[::-1].hex()} that was sealed for this place, found "
        f"{crc[::-1].hex()}: the file is damaged, of another place, another store or an older copy"
    )


def check_trailers(root: Path, but: Collection[str] = ()) -> None:
    """Read every byte of a finished store once and compare it with its checksums.

    The arrays named in `but` are left out. Raises `StoreIncomplete` where a chunk does not give its
    sealed checksum, a feature row its own checksum, or the metadata their digest.
    """
    seal, specs = laid_out_attributes(root).seal, read_specs(root)
    check_seal(root, seal, specs)
    check_chunks(root, [spec for name, spec in specs.items() if name not in but], seal)


def check_chunks(root: Path, specs: Iterable[ArraySpec], seal: Seal | None) -> None:
    """Raise `StoreIncomplete` where a chunk of a finished store changed since it was written."""
    if damage := find_damage(root, specs, seal):
        raise StoreIncomplete(
            f"{damage}, so that nothing can be taken from this store. {mend(root)}"
        )


def find_damage(root: Path, specs: Iterable[ArraySpec], seal: Seal | None = None) -> str | None:
    """The first chunk file that is not as it was written, and what is wrong; else None."""
    with closing(damages(root, specs, seal)) as damaged:
        return next((f"{path}: {what}" for path, what in damaged), None)


def damages(
    root: Path, specs: Iterable[ArraySpec], seal: Seal | None = None
) -> Generator[tuple[Path, str]]:
    """Each chunk file that is not as it was written, and what is wrong.

    Such a file does not give its trailer, its sealed one or the checksums of its feature rows.
    Several threads read each file once. Shows a progress bar on a terminal after one second.
    """
    files = [(spec, chunk) for spec in specs for chunk in range(spec.chunk_count)]
    sums = None
    if features := next((spec for spec, _ in files if spec.name == FEATURES), None):
        with suppress(StoreIncomplete):  # a damaged file of checksums is named as such
            checksums = read_spec(root, CHECKSUMS)
            if checksums.shape == features.shape[:1]:  # else the metadata are damaged
                sums = read_rows(root, checksums)

    def check(file: tuple[ArraySpec, int]) -> tuple[Path, str]:
        spec, chunk = file
        of_rows = sums if spec.name == FEATURES else None
        sealed = sealed_trailer(seal, spec.name, chunk)
        return chunk_path(root, spec, chunk), _chunk_damage(root, spec, chunk, sealed, of_rows)

    with ThreadPoolExecutor(_THREADS) as pool:
        checked = pool.map(check, files)
        total = len(files)
        bar = tqdm(checked, "checksums", total, unit="file", leave=False, disable=None, delay=1)
        try:
            yield from ((path, what) for path, what in bar if what)
        finally:
            pool.shutdown(cancel_futures=True)


def _chunk_damage(
    root: Path, spec: ArraySpec, chunk: int, sealed: bytes | None, sums: NDArray[np.uint32] | None
) -> str:
    """What is wrong with a chunk file, if anything; `sums` are those of all feature rows."""
    path, bad = chunk_path(root, spec, chunk), list[int]()
    if sums is None:
        return read_chunk(path, spec, sealed=sealed).damage or ""
    rows = spec.chunk_rows_of(chunk)

    def compare(first: int, values: NDArray[Any]) -> None:
        within = rows[first : first + len(values)]  # the rest is padding
        if within:
            wrong = row_checksums(values[: len(within)]) != sums[within.start : within.stop]
            bad.extend((within.start + np.flatnonzero(wrong)).tolist())

    what = read_chunk(path, spec, compare, sealed).damage
    if not bad:
        return what or ""
    return _wrong_rows(spec, bad) if what is None else f"{what}; {_wrong_rows(spec, bad)}"


def _wrong_rows(spec: ArraySpec, bad: Sequence[int]) -> str:
    if len(bad) == 1:
        return f"row {bad[0]} of {spec.name} does not give its checksum"
    rows = f"{len(bad)} rows from {bad[0]} to {bad[-1]}"
    return f"{rows} of {spec.name} do not give their checksums"


def read_rows(root: Path, spec: ArraySpec, start: int = 0, stop: int | None = None) -> NDArray[Any]:
    """Rows start..stop - 1 (by default all) of an array of a store or a build, from disk.

    Raises `StoreIncomplete` where a chunk file is missing or ends before them.
    """
    stop = spec.shape[0] if stop is None else stop
    border = store_border(root)
    chunks = range(start // spec.chunk_rows, -(-stop // spec.chunk_rows))
    for chunk in chunks if spec.row_bytes else ():  # before allocating memory
        border.check_file(chunk_path(root, spec, chunk))
    rows = np.zeros((stop - start, *spec.shape[1:]), spec.dtype)
    for chunk, offset, data in _parts(spec, start, rows):
        path = chunk_path(root, spec, chunk)
        with path.open("rb") as file:
            file.seek(offset)
            if file.readinto(data.data) != len(data):
                raise border.refusal(path, "the file ends early")
    return rows


@dataclass(frozen=True)
class ChunkState:
    """The state of a chunk file that was read once from end to end."""

    bytes: int
    """Bytes of rows and trailer that could be read."""
    crc: int
    """The crc32c of the rows, including padding."""
    damage: str | None
    """What was expected and found; None where the file gives its trailer."""


def read_chunk(
    path: Path,
    spec: ArraySpec,
    visit: Callable[[int, NDArray[Any]], object] | None = None,
    sealed: bytes | None = None,
) -> ChunkState:
    """Read a chunk file block by block and compare it with its trailer, and with the `sealed` one.

    `visit` gets each block's first row within the chunk and the block's complete rows, which are
    valid only until the next block.
    """
    together = max(1, min(spec.chunk_rows, BLOCK_BYTES // spec.row_bytes))
    buffer = np.empty(together * spec.row_bytes, np.uint8)
    trailer = np.zeros(1, "<u4")
    done = crc = 0
    if path.exists() and not path.is_file():
        return ChunkState(0, 0, "expected a file, found a folder, pipe or device")
    try:
        with path.open("rb") as file:
            for first in range(0, spec.chunk_rows, together):
                block = buffer[: min(together, spec.chunk_rows - first) * spec.row_bytes]
                got = file.readinto(block.data)
                done, crc = done + got, google_crc32c.extend(crc, block[:got])
                if visit is not None:
                    rows = block[: got // spec.row_bytes * spec.row_bytes].view(spec.dtype)
                    visit(first, rows.reshape(-1, *spec.shape[1:]))
                if got < len(block):
                    break
            done += file.readinto(trailer.data)
            size = os.fstat(file.fileno()).st_size
    except OSError as error:
        return ChunkState(done, crc, f"cannot be read at byte {done}: {error.strerror}")
    if size != spec.chunk_bytes + TRAILER_BYTES:
        return ChunkState(
            done, crc, f"expected {spec.chunk_bytes + TRAILER_BYTES} bytes, found {size}"
        )
    if trailer[0] != crc:
        wrong = f"expected the crc32c {trailer[0]:08x} of its trailer, found {crc:08x}"
        return ChunkState(done, crc, wrong)
    return ChunkState(done, crc, _unsealed(trailer.tobytes(), sealed))


class ChunkFiles:
    """The files of one array of a build, written by row.

    A linked chunk of streams, ticks or episodes also belongs to another store: `write` skips it.
    """

    def __init__(self, root: Path, spec: ArraySpec) -> None:
        self._root = root
        self.spec = spec
        self.paths = chunk_paths(root, spec)
        self._row_by_row = spec.name in INCREMENTAL
        self._descriptors: dict[int, int] = {}
        self._unsynced: set[int] = set()
        self._sums: dict[int, tuple[int, int]] = {}

    def allocate(self) -> None:
        """Reserve the space of every row; chunk files get their full size, without a trailer."""
        for chunk, path in enumerate(self.paths):
            if self.is_linked(chunk):
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            with disk_full_named(path):
                descriptor = self._descriptor(chunk)
                used = len(self.spec.chunk_rows_of(chunk)) * self.spec.row_bytes
                os.posix_fallocate(descriptor, 0, used)
                os.ftruncate(descriptor, self.spec.chunk_bytes)

    def is_linked(self, chunk: int) -> bool:
        """Whether this file also belongs to another store and so must not be written."""
        path = self.paths[chunk]
        return not self._row_by_row and path.exists() and path.stat().st_nlink > 1

    def link(self, chunk: int, source: Path) -> bool:
        """Take a chunk over from another store as it is; False where files cannot be linked."""
        self.paths[chunk].parent.mkdir(parents=True, exist_ok=True)
        try:
            # The path may be a cache's symbolic link; link the file behind it.
            os.link(source.resolve(), self.paths[chunk])
        except OSError as error:
            if error.errno not in (errno.EXDEV, errno.EPERM, errno.EMLINK, errno.EOPNOTSUPP):
                raise
            return False
        return True

    def write(self, start: int, values: NDArray[Any]) -> None:
        """Write consecutive rows from `start`."""
        if not self.spec.row_bytes or not len(values):
            return
        block = np.ascontiguousarray(values, self.spec.dtype)
        assert block.shape[1:] == self.spec.shape[1:], (block.shape, self.spec)
        assert start + len(block) <= self.spec.shape[0], (start, len(block), self.spec)
        for chunk, offset, data in _parts(self.spec, start, block):
            if self.is_linked(chunk):
                continue
            with disk_full_named(self.paths[chunk]):
                descriptor = self._descriptor(chunk)
                if os.fstat(descriptor).st_size > self.spec.chunk_bytes:
                    os.ftruncate(descriptor, self.spec.chunk_bytes)  # drop the old trailer
                _write_all(descriptor, data.data, offset)
            self._sum_up(chunk, offset, data)
            self._unsynced.add(chunk)

    def read(self, start: int, count: int) -> NDArray[Any]:
        """Consecutive rows from disk, whichever process or host wrote them."""
        return read_rows(self._root, self.spec, start, start + count)

    def sync(self) -> None:
        """Wait until everything written has reached the disk."""
        for chunk in self._unsynced:
            with disk_full_named(self.paths[chunk]):
                os.fdatasync(self._descriptor(chunk))
        self._unsynced.clear()

    def write_trailers(self) -> None:
        """Write each chunk's trailer, computed from the rows given to `write`; others are zero.

        Only for arrays that were written here in order from their first row. Waits for the disk.
        """
        for chunk in range(len(self.paths)):
            if not self.is_linked(chunk):
                done, crc = self._sums.get(chunk, (0, 0))
                assert done >= 0, f"{self.spec.name} was not written in order"
                rest = self.spec.chunk_bytes - done
                self._write_trailer(chunk, google_crc32c.extend(crc, bytes(rest)))
        self.sync()

    def seal(self) -> None:
        """Compare each chunk with its trailer, or write it where there is none yet.

        A second run changes nothing. A trailer that does not match is written again if the array is
        written row by row: its rows have checksums of their own, and after a power loss a file may
        have its full size without its last bytes. Otherwise raises `StoreIncomplete`; the next run
        then lays the build out again.
        """
        for chunk, path in enumerate(self.paths):
            if self.is_linked(chunk):
                continue
            state = read_chunk(path, self.spec)
            if state.damage:
                has_trailer = path.stat().st_size > self.spec.chunk_bytes
                whole = state.bytes >= self.spec.chunk_bytes
                if not whole or (has_trailer and not self._row_by_row):
                    raise StoreIncomplete(
                        f"{path}: {state.damage}: the disk did not keep what was written. Run the "
                        "same command again: it writes streams, ticks and episodes anew and keeps "
                        "the feature rows."
                    )
                self._write_trailer(chunk, state.crc)
            with disk_full_named(path):
                os.fsync(self._descriptor(chunk))

    def close(self) -> None:
        """Close the files."""
        for descriptor in self._descriptors.values():
            os.close(descriptor)
        self._descriptors.clear()

    def _sum_up(self, chunk: int, offset: int, data: NDArray[np.uint8]) -> None:
        """Extend the checksum of a chunk written in order; -1 marks one that was not."""
        done, crc = self._sums.get(chunk, (0, 0))
        in_order = offset == done
        crc = google_crc32c.extend(crc, data) if in_order else 0
        self._sums[chunk] = (done + data.nbytes if in_order else -1, crc)

    def _write_trailer(self, chunk: int, crc: int) -> None:
        trailer = memoryview(crc.to_bytes(TRAILER_BYTES, "little"))
        with disk_full_named(self.paths[chunk]):
            _write_all(self._descriptor(chunk), trailer, self.spec.chunk_bytes)
        self._unsynced.add(chunk)

    def _descriptor(self, chunk: int) -> int:
        if chunk not in self._descriptors:
            if len(self._descriptors) >= _MOST_OPEN:
                self.sync()
                self.close()
            self._descriptors[chunk] = os.open(self.paths[chunk], os.O_RDWR | os.O_CREAT, 0o644)
        return self._descriptors[chunk]


def _parts(
    spec: ArraySpec, start: int, rows: NDArray[Any]
) -> Iterator[tuple[int, int, NDArray[np.uint8]]]:
    """(chunk, offset in its file, bytes) of consecutive rows from `start`, chunk by chunk."""
    if not rows.nbytes:
        return
    raw, done = rows.reshape(len(rows), -1).view(np.uint8), 0
    while done < len(raw):
        chunk, inside = divmod(start + done, spec.chunk_rows)
        taken = min(len(raw) - done, spec.chunk_rows - inside)
        yield chunk, inside * spec.row_bytes, raw[done : done + taken].reshape(-1)
        done += taken


def _write_all(descriptor: int, block: memoryview, offset: int) -> None:
    while len(block):
        written = os.pwrite(descriptor, block, offset)
        block, offset = block[written:], offset + written
