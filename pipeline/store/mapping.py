"""Chunk files side by side in memory: one flat range over all of them.

One range of addresses is reserved, each file is mapped into its place (`MAP_FIXED`), and one
ndarray spans the whole, so that speed does not depend on how an array is cut into files. Maps are
private and copy-on-write: a write by mistake changes neither the file nor kills the process.
"""

import ctypes
import mmap
import os
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

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
_PROT_NONE = 0
_MAP_FIXED = 0x10
_MAP_NORESERVE = 0x4000
_PRIVATE = mmap.MAP_PRIVATE | _MAP_NORESERVE


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
        raise OSError(code, f"mmap of {length} bytes: {os.strerror(code)}")
    return int(mapped)
