"""Maps chunk files side by side into one flat range of memory.

One range of addresses is reserved, each file is mapped into its place (`MAP_FIXED`), and one
ndarray spans the range, so that speed does not depend on how an array is cut into files. Maps are
private and copy-on-write: an accidental write neither changes the file nor kills the process.

How a map is paged in depends on whether it fits in memory. A map that fits is populated once: every
page is read in the files' order and entered in the page table, so that no gather stops at a page
fault. For a map that does not fit, the kernel reads only requested pages, and each batch requests
all its rows before it copies the first; read-ahead would read hundreds of times the useful bytes.
"""

import ctypes
import errno
import mmap
import os
import weakref
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import TooManyMaps

_LIBC = ctypes.CDLL(None, use_errno=True)
_LIBC.mmap.restype = ctypes.c_void_p
_LIBC.mmap.argtypes = (
    ctypes.c_void_p,
    ctypes.c_size_t,
    ctypes.c_int,
    ctypes.c_int,
    ctypes.c_int,
    ctypes.c_long,
)
_LIBC.munmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t)
_LIBC.madvise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
_PROT_NONE = 0
_MAP_FIXED = 0x10
_MAP_NORESERVE = 0x4000
_PRIVATE = mmap.MAP_PRIVATE | _MAP_NORESERVE
_MADV_POPULATE_READ = 22
"""New in Linux 5.14; Python's `mmap` has no name for it."""
_POPULATE_STEP = 256 * 2**20
_MEMORY_SHARE = 0.8
"""The share of available memory that maps may fill; the rest is for the process."""


def map_flat(
    paths: Sequence[Path], chunk_bytes: int, shape: tuple[int, ...], dtype: np.dtype[Any]
) -> NDArray[Any]:
    """One array over the first `chunk_bytes` of each file, in order; nothing is read yet.

    The map lives as long as the array or a view of it.
    """
    count = int(np.prod(shape))
    if not count:
        return np.zeros(shape, dtype)
    assert len(paths) == 1 or chunk_bytes % mmap.PAGESIZE == 0, (chunk_bytes, mmap.PAGESIZE)
    total = len(paths) * chunk_bytes
    start = _mmap(None, total, _PROT_NONE, _PRIVATE | mmap.MAP_ANONYMOUS, -1)
    buffer = (ctypes.c_char * total).from_address(start)
    weakref.finalize(buffer, _LIBC.munmap, start, total).atexit = False
    for index, path in enumerate(paths):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            _mmap(
                start + index * chunk_bytes,
                chunk_bytes,
                mmap.PROT_READ | mmap.PROT_WRITE,
                _PRIVATE | _MAP_FIXED,
                descriptor,
            )
        finally:
            os.close(descriptor)
    return np.frombuffer(cast(Any, buffer), dtype, count).reshape(shape)


def _mmap(address: int | None, length: int, protection: int, flags: int, descriptor: int) -> int:
    mapped = _LIBC.mmap(address, length, protection, flags, descriptor, 0)
    if mapped == ctypes.c_void_p(-1).value:
        code = ctypes.get_errno()
        if code == errno.ENOMEM:
            limit = Path("/proc/sys/vm/max_map_count").read_text(encoding="ascii").strip()
            raise TooManyMaps(
                f"the kernel refuses to map another file; a process may have {limit} maps, and a "
                "store takes one a chunk file. Raise it (sysctl vm.max_map_count), or extract into "
                "several stores."
            )
        raise OSError(code, f"mmap of {length} bytes: {os.strerror(code)}")
    return int(mapped)


def fitting(sizes: Mapping[str, int], available: int, share: float = _MEMORY_SHARE) -> list[str]:
    """The names whose bytes fit together in a share of the available ones, smallest first."""
    left = int(available * share)
    names: list[str] = []
    for name in sorted(sizes, key=lambda name: sizes[name]):
        left -= sizes[name]
        if left >= 0:
            names.append(name)
    return names


def populate(array: NDArray[Any]) -> None:
    """Read a map from `map_flat` into memory, in order; returns when all of it is there.

    A kernel before Linux 5.14 only begins to read, and page faults remain.
    """
    start, stop = _pages(array, 0, array.nbytes)
    for begin in range(start, stop, _POPULATE_STEP):
        length = min(_POPULATE_STEP, stop - begin)
        try:
            _madvise(begin, length, _MADV_POPULATE_READ)
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise
            _madvise(begin, length, mmap.MADV_WILLNEED)


def read_at_random(array: NDArray[Any]) -> None:
    """Tell the kernel to read only the requested pages of a map, without read-ahead."""
    if array.nbytes:
        start, stop = _pages(array, 0, array.nbytes)
        _madvise(start, stop - start, mmap.MADV_RANDOM)


def will_need(array: NDArray[Any], first: NDArray[np.int64], rows: int) -> None:
    """Begin to read rows `first[i]` to `first[i] + rows - 1` of a map, for all i at once.

    This costs one kernel call per i, and saves one wait for the disk per i.
    """
    if not array.nbytes:
        return
    row_bytes = array.nbytes // len(array)
    for row in np.unique(first).tolist():
        start, stop = _pages(array, row * row_bytes, (row + rows) * row_bytes)
        _madvise(start, stop - start, mmap.MADV_WILLNEED)


def _pages(array: NDArray[Any], begin: int, end: int) -> tuple[int, int]:
    """The addresses from the page that holds byte `begin` of an array to its byte `end`."""
    address = array.ctypes.data
    start = (address + max(0, begin)) // mmap.PAGESIZE * mmap.PAGESIZE
    return start, address + min(end, array.nbytes)


def _madvise(address: int, length: int, advice: int) -> None:
    if _LIBC.madvise(address, length, advice):
        code = ctypes.get_errno()
        raise OSError(code, f"madvise({advice}) of {length} bytes: {os.strerror(code)}")
