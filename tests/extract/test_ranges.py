"""Ranges hold every missing row once, and never more than a task may have."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.data.episode import by_episode
from pipeline.extract.dask_cluster import ranges_of


@st.composite
def missing_rows(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Episodes of 0 to 9 rows, and some of their rows."""
    lengths = draw(st.lists(st.integers(0, 9), min_size=1, max_size=12))
    edges = np.cumsum([0, *lengths])
    chosen = draw(st.lists(st.booleans(), min_size=int(edges[-1]), max_size=int(edges[-1])))
    return np.flatnonzero(chosen), edges


@given(rows=missing_rows(), batch=st.integers(1, 6), together=st.sampled_from([1, 2, 4]))
def test_blocks_that_share_a_page_stay_together(rows, batch, together):
    missing, _ = rows
    ranges = ranges_of(missing, batch, 8, together)
    assert np.concatenate([[], *ranges]).tolist() == missing.tolist()
    blocks = [set((part // together).tolist()) for part in ranges]
    assert sum(map(len, blocks)) == len(set().union(*blocks)), "a block stands in two ranges"
    for part in ranges:
        assert len(part) < batch + together
        assert len(set((part // 8).tolist())) <= 1, "a range lies in two chunks"


@given(missing_rows())
def test_the_rows_of_a_range_are_told_apart_by_episode(rows):
    missing, edges = rows
    for episode, its_rows in by_episode(missing, edges) if len(missing) else ():
        assert ((edges[episode] <= its_rows) & (its_rows < edges[episode + 1])).all()


def test_a_batch_is_filled_where_nothing_forbids_it():
    ranges = ranges_of(np.arange(10), 4, 4096)
    assert [one.tolist() for one in ranges] == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]
