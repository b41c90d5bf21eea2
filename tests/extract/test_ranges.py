"""Ranges hold every missing row once, and never more than a task may have."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.data.row_range import by_episode
from pipeline.extract.cluster import PAGE_BYTES, ranges_of, rows_between_pages


@st.composite
def missing_rows(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Episodes of 0 to 9 rows, and some of their rows."""
    lengths = draw(st.lists(st.integers(0, 9), min_size=1, max_size=12))
    edges = np.cumsum([0, *lengths])
    chosen = draw(st.lists(st.booleans(), min_size=int(edges[-1]), max_size=int(edges[-1])))
    return np.flatnonzero(chosen), edges


@given(rows=missing_rows(), batch=st.integers(1, 6), chunk_rows=st.sampled_from([4, 8, 32]))
def test_a_range_is_of_one_chunk_and_one_episode(rows, batch, chunk_rows):
    missing, edges = rows
    ranges = list(ranges_of(missing, edges, chunk_rows, batch))
    assert np.concatenate([[], *ranges]).tolist() == missing.tolist()
    for one in ranges:
        assert 0 < len(one) <= batch
        assert len(set(one // chunk_rows)) == 1
        assert len(list(by_episode(one, edges))) == 1


@given(
    rows=missing_rows(), batch=st.integers(1, 6), shape=st.sampled_from([(4, 4), (8, 2), (32, 4)])
)
def test_blocks_that_share_a_page_stay_together(rows, batch, shape):
    chunk_rows, together = shape
    missing, edges = rows
    ranges = list(ranges_of(missing, edges, chunk_rows, batch, together))
    assert np.concatenate([[], *ranges]).tolist() == missing.tolist()
    blocks = [set((one // together).tolist()) for one in ranges]
    assert sum(map(len, blocks)) == len(set().union(*blocks)), "a block stands in two ranges"
    for one, its_blocks in zip(ranges, blocks, strict=True):
        assert len(set(one // chunk_rows)) == 1
        assert len(one) <= batch or len(its_blocks) == 1
        for (_, before), (_, after) in zip(
            list(by_episode(one, edges)), list(by_episode(one, edges))[1:], strict=False
        ):
            assert before[-1] // together == after[0] // together, "could have been cut there"


@given(missing_rows())
def test_the_rows_of_a_range_are_told_apart_by_episode(rows):
    missing, edges = rows
    for episode, its_rows in by_episode(missing, edges) if len(missing) else ():
        assert ((edges[episode] <= its_rows) & (its_rows < edges[episode + 1])).all()


def test_a_batch_is_filled_where_nothing_forbids_it():
    ranges = ranges_of(np.arange(10), np.array([0, 10]), 4096, 4)
    assert [one.tolist() for one in ranges] == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]


@pytest.mark.parametrize(("row_bytes", "rows"), [(4096, 1), (8192, 1), (7168, 4), (96, 128)])
def test_rows_between_pages(row_bytes, rows):
    assert rows_between_pages(row_bytes) == rows
    assert rows * row_bytes % PAGE_BYTES == 0
    assert 4096 % rows == 0, "chunks are multiples of 4,096 rows"
