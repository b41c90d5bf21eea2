"""What lives on a device is gathered there to the same bits as from the map."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.store import Batch, FeatureStore
from pipeline.store.gather import WIDE
from pipeline.train.batches import BatchIndices, DeviceStore, Lags, Prefetch, Windows, draws

CPU = torch.device("cpu")
FIELDS = [{*WIDE}, {"sensor"}, {"features", "action"}, {"state"}]
Plan = Callable[..., list[BatchIndices]]
Same = Callable[[Batch, Batch], bool]


@pytest.mark.parametrize("fields", FIELDS, ids=lambda fields: "+".join(sorted(fields)))
@pytest.mark.parametrize("window", [1, 40])
def test_batches_are_those_of_the_map(
    any_store: FeatureStore, draw_plan: Plan, same_bits: Same, fields: set[str], window: int
) -> None:
    windows, lags = Windows(4, window, window + 1), Lags(2, 0.13, 0.2)
    wanted = [*draw_plan(any_store, 6), *draws(np.arange(any_store.ticks), 32)]
    resident = DeviceStore(any_store, fields, CPU)
    for late in (Lags(), lags):
        with (
            Prefetch(any_store, wanted, windows, CPU, lags=late) as mapped,
            Prefetch(any_store, wanted, windows, CPU, lags=late, resident=resident) as device,
        ):
            for (draw, expected), (found, batch) in zip(mapped, device, strict=True):
                assert found is draw
                assert same_bits(batch, expected)
                assert batch.sizes == expected.sizes


def test_a_batch_stays_as_it_is_until_the_next(
    any_store: FeatureStore, draw_plan: Plan, same_bits: Same
) -> None:
    resident = DeviceStore(any_store, {"features", "sensor"}, CPU)
    windows = Windows(4, 6, 5)
    with Prefetch(any_store, draw_plan(any_store, 8), windows, CPU, resident=resident) as batches:
        for draw, batch in batches:
            again = any_store.gather(draw.ticks, 4, 6, 5, variants=draw.variants)
            assert same_bits(batch, again)


def test_it_is_a_copy(tiny_store: Callable[..., Path], tmp_path: Path) -> None:
    store = FeatureStore.open(tiny_store(tmp_path))
    before = store.gather([40]).features.clone()
    resident = DeviceStore(store, {"features"}, CPU)
    store.array("vl/features")[:] = 0
    with Prefetch(
        store, [BatchIndices(np.array([40]))], Windows(8, 65, 100), CPU, resident=resident
    ) as batches:
        assert torch.equal(next(batches)[1].features, before)


@pytest.mark.gpu
@pytest.mark.parametrize("fields", FIELDS, ids=lambda fields: "+".join(sorted(fields)))
def test_on_a_gpu(
    any_store: FeatureStore, draw_plan: Plan, same_bits: Same, fields: set[str]
) -> None:
    device, windows = torch.device("cuda"), Windows(4, 40, 5)
    wanted = [*draw_plan(any_store, 6), *draws(np.arange(any_store.ticks), 32)]
    resident = DeviceStore(any_store, fields, device)
    with Prefetch(any_store, wanted, windows, device, resident=resident) as batches:
        kept = [*batches]
    for draw, batch in kept:
        assert batch.features.is_cuda and batch.sensor.is_cuda
        expected = any_store.gather(draw.ticks, 4, 40, 5, variants=draw.variants)
        assert same_bits(batch, expected)
