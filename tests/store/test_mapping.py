"""Maps over chunk files, and how they are paged in."""

import ctypes
import errno
import mmap
import os
from pathlib import Path

import numpy as np
import pytest

from pipeline.store.memory_map import fitting, map_flat, populate, read_at_random, will_need

PAGE = mmap.PAGESIZE
ROWS, CHUNK = 4096, 1024
F4 = np.dtype("f4")


@pytest.fixture
def values() -> np.ndarray:
    return np.random.default_rng(0).random((ROWS, 8), np.float32)


@pytest.fixture
def mapped(tmp_path: Path, values: np.ndarray) -> np.ndarray:
    paths = []
    for index in range(ROWS // CHUNK):
        paths.append(tmp_path / str(index))
        paths[-1].write_bytes(values[index * CHUNK : (index + 1) * CHUNK].tobytes() + b"tail")
    return map_flat(paths, CHUNK * 32, values.shape, F4)


def in_page_table(array: np.ndarray) -> int:
    """Pages of the array that this process can read without a page fault."""
    with open("/proc/self/pagemap", "rb") as pages:
        pages.seek(array.ctypes.data // PAGE * 8)
        entries = np.frombuffer(pages.read(-(-array.nbytes // PAGE) * 8), np.uint64)
    return int((entries >> np.uint64(63)).sum())


def test_files_are_one_array_that_outlives_them_and_lives_in_a_view(mapped, values, tmp_path):
    assert np.array_equal(mapped, values)
    for path in tmp_path.iterdir():
        path.unlink()
    tail = mapped[-5:]
    del mapped
    assert np.array_equal(tail, values[-5:])


def test_populate_enters_every_page(mapped, values):
    assert in_page_table(mapped) == 0
    populate(mapped)
    assert in_page_table(mapped) == mapped.nbytes // PAGE
    assert np.array_equal(mapped, values)


def test_populate_of_nothing_is_nothing():
    populate(np.zeros((0, 3)))
    read_at_random(np.zeros((0, 3)))
    will_need(np.zeros((4, 0)), np.array([0]), 1)


def test_a_kernel_that_cannot_populate_is_asked_to_read(mapped, values, monkeypatch):
    asked = []

    def madvise(address: int, length: int, advice: int) -> int:
        asked.append(advice)
        ctypes.set_errno(errno.EINVAL)
        return -1 if advice == 22 else 0

    monkeypatch.setattr(mapping._LIBC, "madvise", madvise)
    populate(mapped)
    assert asked == [22, mmap.MADV_WILLNEED]


def test_a_file_cut_short_is_an_error_and_no_signal(mapped, tmp_path):
    os.truncate(tmp_path / "2", 0)
    with pytest.raises(OSError, match="madvise"):
        populate(mapped)


def test_advice_covers_the_rows_and_nothing_beyond_the_map(mapped, values, monkeypatch):
    seen = []
    real = mapping._LIBC.madvise

    def madvise(address: int, length: int, advice: int) -> int:
        seen.append((address - mapped.ctypes.data, length, advice))
        return real(address, length, advice)

    monkeypatch.setattr(mapping._LIBC, "madvise", madvise)
    will_need(mapped, np.array([4000, -6, 130, 130]), 128)
    assert [advice for *_, advice in seen] == [mmap.MADV_WILLNEED] * 3
    for (start, length, _), (first, last) in zip(
        seen, [(0, 122), (130, 258), (4000, 4096)], strict=True
    ):
        assert start % PAGE == 0
        assert start <= first * 32 and start + length == last * 32
    read_at_random(mapped)
    assert seen[-1][0] == 0 and seen[-1][1] == mapped.nbytes
    assert np.array_equal(mapped, values)


def test_what_fits_is_taken_the_smallest_first():
    sizes = {"a": 50, "b": 10, "c": 30}
    assert fitting(sizes, 125) == ["b", "c", "a"]
    assert fitting(sizes, 100) == ["b", "c"]
    assert fitting(sizes, 12) == []
