"""A live feed hands out the store's batches with the rows of their ticks."""

import threading
from collections.abc import Iterable, Iterator
from dataclasses import fields

import numpy as np
import pytest
import torch

from pipeline.base.errors import RecordingError
from pipeline.store import Batch, FeatureStore
from pipeline.train.batches import BatchIndices, Windows
from pipeline.train.finetuning_rows import (
    LiveFeed,
    LiveRows,
    check_spec,
    find_recordings,
    known_digests,
)
from pipeline.vlm.preparation import Preparer

WINDOWS = Windows(2, 1, 3)
CPU = torch.device("cpu")


@pytest.fixture
def feed(store, params):
    """`feed(plan)`, over rows of its own."""

    def make(plan: Iterable[BatchIndices], threads: int = 2) -> LiveFeed:
        with known_digests(store) as digests:
            spec = check_spec(store, params(), digests)
        rows = LiveRows(store, find_recordings(store, params()), Preparer(params().vlm, spec))
        return LiveFeed(store, rows, plan, WINDOWS, CPU, threads)

    return make


def plan_of(store: FeatureStore, draws: int, batch: int) -> list[BatchIndices]:
    rng = np.random.default_rng(1)
    return [BatchIndices(rng.integers(0, store.ticks, batch)) for _ in range(draws)]


def test_batches_are_the_stores_and_rows_those_of_their_ticks(store, feed):
    plan = plan_of(store, 7, 9)
    seen = 0
    with feed(plan, 3) as batches:
        for wanted, (draw, batch) in zip(plan, batches, strict=True):
            assert draw is wanted
            expected = store.gather(draw.ticks, 2, 1, 3)
            for field in fields(Batch):
                stream = getattr(expected, field.name)
                torch.testing.assert_close(
                    getattr(batch, field.name), stream, rtol=0, atol=0, equal_nan=True
                )
            vl_row = store.array("tick/vl_row")[draw.ticks]
            assert len(batch.rows) == len(np.unique(vl_row)), "each distinct row once"
            same = batch.row_of[:, None] == batch.row_of
            assert (same.numpy() == (vl_row[:, None] == vl_row)).all()
            seen += 1
        assert batches.waited_s > 0
    assert seen == len(plan)


def test_another_device_takes_the_tensors_and_leaves_the_rows(store, feed):
    with feed(plan_of(store, 1, 4)) as batches:
        _, batch = next(batches)
    moved = batch.to("meta")
    assert moved.features.is_meta
    assert moved.row_of.is_meta
    assert moved.rows is batch.rows


def test_a_frame_that_is_gone_comes_out_at_its_batch(store, feed, own_recordings):
    first, second = store.episodes[0].ticks, store.episodes[1].ticks

    def plan() -> Iterator[BatchIndices]:  # read once the recordings are open, before the first row
        for frame in (own_recordings / "Follow_disc" / "episode_1" / "images").rglob("*.jpg"):
            frame.write_bytes(b"")
        yield from (BatchIndices(np.array(ticks[:3])) for ticks in (first, second, first))

    with feed(plan()) as batches:
        next(batches)
        with pytest.raises(RecordingError, match="episode_1"):
            next(batches)


def test_threads_end_with_the_feed(store, feed):
    before = {*threading.enumerate()}
    with feed(plan_of(store, 50, 16)) as batches:
        next(batches)
    assert {*threading.enumerate()} <= before
    with pytest.raises(StopIteration):
        next(batches)
