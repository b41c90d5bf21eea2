"""Batches come in order, whole, and are not touched while they are in use."""

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.base.config import TrainHeadParams
from pipeline.store import Batch, FeatureStore
from pipeline.train.batches import BatchIndices, Lags, Prefetch, Windows, cut_batches, evenly

CPU = torch.device("cpu")
WINDOWS = Windows(horizon=4, sensor_window=6, state_window=5)
OTHER = {"slots": 6, "dtype": "bfloat16", "sensor_channels": 0, "state_dim": 0}


@pytest.fixture(params=["plain", "other"])
def any_store(request, store, store_saying, tmp_path):
    """The small store, and one in bfloat16, of two variants a row and without readings."""
    if request.param == "plain":
        return store
    return store_saying(tmp_path, {"feature_spec": {"variants": 2}}, **OTHER)


def draw_plan(store: FeatureStore, batches: int) -> list[BatchIndices]:
    """Random ticks of random variants."""
    rng = np.random.default_rng(0)
    return [
        BatchIndices(rng.integers(0, store.ticks, 7), rng.integers(0, store.variants, 7))
        for _ in range(batches)
    ]


def at(*ticks: int) -> BatchIndices:
    return BatchIndices(np.array(ticks))


def fresh(store: FeatureStore, draw: BatchIndices, **lags: Any) -> Batch:
    sizes = {"horizon": 4, "sensor_window": 6, "state_window": 5}
    return store.gather(draw.ticks, **sizes, **lags, variants=draw.variants)


def equal(found: Batch, expected: Batch) -> bool:
    return all(torch.equal(getattr(found, name), value) for name, value in vars(expected).items())


def threads() -> int:
    return sum(thread.name.startswith("prefetch") for thread in threading.enumerate())


def test_batches_are_those_of_gather_in_the_order_of_the_plan(any_store):
    wanted = draw_plan(any_store, 12)
    for buffers in (2, 3):
        with Prefetch(any_store, wanted, WINDOWS, CPU, buffers) as batches:
            for draw, (found, batch) in zip(wanted, batches, strict=True):
                assert found is draw
                assert equal(batch, fresh(any_store, draw))
                varied = any_store.variants > 1 and draw.variants is not None
                plain = fresh(any_store, BatchIndices(draw.ticks))
                assert equal(batch, plain) == (not varied or not draw.variants.any())


def test_draws_are_the_ticks_in_order_and_the_plain_frames():
    found = cut_batches(np.arange(20), 8)
    expected = [[*range(8)], [*range(8, 16)], [*range(16, 20)]]
    assert [draw.ticks.tolist() for draw in found] == expected
    assert all(draw.variants is None for draw in found)


def test_lags_are_those_of_gather(store):
    rows, late_s = np.arange(7) % 3, np.arange(7) / 10  # of each sample
    wanted = [replace(indices, lags=Lags(rows, late_s, 0.2)) for indices in draw_plan(store, 2)]
    with Prefetch(store, wanted, WINDOWS, CPU) as batches:
        for draw, batch in batches:
            late = fresh(store, draw, feature_lag=rows, sensor_lag_s=late_s, state_lag_s=0.2)
            assert equal(batch, late)
            assert not equal(batch, fresh(store, draw))


def test_a_batch_is_not_overwritten_before_the_next_is_asked_for(store):
    with Prefetch(store, draw_plan(store, 6), WINDOWS, CPU) as batches:
        for draw, batch in batches:
            time.sleep(0.02)  # the thread has long filled what it may
            assert torch.equal(batch.sensor, fresh(store, draw).sensor)


def test_buffers_are_reused(store):
    with Prefetch(store, draw_plan(store, 12), WINDOWS, CPU) as batches:
        places = {batch.sensor.data_ptr() for _, batch in batches}
    assert len(places) == 2


def test_an_exception_comes_out_at_its_batch_and_ends_the_thread(store):
    wanted = [at(0, 1), at(2, 3), at(store.ticks)]
    batches = Prefetch(store, wanted, WINDOWS, CPU)
    assert next(batches)[0].ticks.tolist() == [0, 1]
    assert next(batches)[0].ticks.tolist() == [2, 3]
    with pytest.raises(IndexError, match="ticks lie in"):
        next(batches)
    with pytest.raises(StopIteration):
        next(batches)
    assert threads() == 0


def test_leaving_early_ends_the_thread_and_an_endless_plan(store):
    def endless() -> Iterator[BatchIndices]:
        while True:
            yield at(1, 2, 3)

    with Prefetch(store, endless(), WINDOWS, CPU) as batches:
        draw, batch = next(batches)
        assert threads() == 1
    assert threads() == 0
    assert torch.equal(batch.action, fresh(store, draw).action)


def test_a_disabled_encoder_costs_a_single_reading():
    params = TrainHeadParams(sensor_enabled=False, sensor_window=650, state_window=10)
    assert Windows.of(params) == Windows(8, 1, 20, 0.1, 2.0)  # the state reaches back to the frame
    assert Windows.of(TrainHeadParams(robot_state_enabled=False)).state_window == 1


def test_no_more_ticks_than_asked_for_and_evenly():
    assert evenly(np.arange(5000), 3).tolist() == [0, 2500, 4999]
    assert evenly(np.arange(3), 10).tolist() == [0, 1, 2]
    assert evenly(np.arange(0), 10).tolist() == []


@pytest.mark.gpu
def test_on_a_gpu_batches_are_copies_that_stay(store):
    wanted = draw_plan(store, 12)
    with Prefetch(store, wanted, WINDOWS, torch.device("cuda")) as batches:
        kept = [batch for _, batch in batches]
    for draw, batch in zip(wanted, kept, strict=True):
        assert batch.sensor.is_cuda
        assert torch.equal(batch.sensor.cpu(), fresh(store, draw).sensor)
