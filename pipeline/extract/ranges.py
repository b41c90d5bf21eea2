"""Cut the missing rows into what one worker computes in one go."""

import math
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

PAGE_BYTES = 4096


def rows_between_pages(row_bytes: int) -> int:
    """Every how many rows one begins where a page of its file begins.

    Divides every chunk: chunks are multiples of 4,096 rows.
    """
    return PAGE_BYTES // math.gcd(row_bytes, PAGE_BYTES)


def ranges_of(
    missing: NDArray[np.int64],
    vl_start: NDArray[np.int64],
    chunk_rows: int,
    batch: int,
    together: int = 1,
) -> Iterator[NDArray[np.int64]]:
    """Rows (ascending, of `missing`) that one task computes, range after range.

    A range lies within one chunk and one episode (`vl_start`, (episode + 1,)) and has at most
    `batch` rows. Blocks of `together` rows are never cut: where hosts must not share a page, a
    range may so hold more rows, or the end of one episode and the beginning of the next.
    """
    chunks = np.flatnonzero(np.diff(missing // chunk_rows)) + 1
    for rows in np.split(missing, chunks):
        if len(rows):
            yield from _ranges_of_chunk(rows, vl_start, batch, together)


def _ranges_of_chunk(
    rows: NDArray[np.int64], vl_start: NDArray[np.int64], batch: int, together: int
) -> Iterator[NDArray[np.int64]]:
    episode = np.searchsorted(vl_start, rows, side="right")
    blocks = [0, *(np.flatnonzero(np.diff(rows // together)) + 1).tolist(), len(rows)]
    begin = 0
    for start, stop in pairwise(blocks):
        other_episode = start > 0 and episode[start] != episode[start - 1]
        if start > begin and (other_episode or stop - begin > batch):
            yield rows[begin:start]
            begin = start
    yield rows[begin:]


def by_episode(
    rows: NDArray[np.int64], vl_start: NDArray[np.int64]
) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """The episodes that a range touches, and its rows of each."""
    episode = np.searchsorted(vl_start, rows, side="right") - 1
    for part in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(episode)) + 1):
        yield int(episode[part[0]]), rows[part]
