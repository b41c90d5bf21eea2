"""What lives on a device is gathered there to the same bits as from the map; what does is said."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.store import FeatureStore
from pipeline.store.gather import WIDE
from pipeline.train.batches import (
    BatchIndices,
    DeviceStore,
    Lags,
    Prefetch,
    Windows,
    choose_feed,
    cut_batches,
)
from pipeline.train.loop import Trainer

CPU, CUDA = torch.device("cpu"), torch.device("cuda")
ALL = frozenset({"features", "sensor", "state", "action"})
FIELDS = [{*WIDE}, {"sensor"}, {"features", "action"}, {"state"}]


def test_batches_are_those_of_the_map(any_store, draw_plan, same_bits):
    wanted = [*draw_plan(any_store, 6), *cut_batches(np.arange(any_store.ticks), 32)]
    for fields in FIELDS:
        resident = DeviceStore(any_store, fields, CPU)
        for window, late in ((1, Lags()), (40, Lags()), (40, Lags(2, 0.13, 0.2))):
            windows = Windows(4, window, window + 1, feature_history=1 + window // 20)
            asked = [replace(indices, lags=late) for indices in wanted]
            with (
                Prefetch(any_store, asked, windows, CPU) as mapped,
                Prefetch(any_store, asked, windows, CPU, resident=resident) as device,
            ):
                for (draw, expected), (found, batch) in zip(mapped, device, strict=True):
                    assert found is draw
                    assert same_bits(batch, expected), fields
                    assert batch.sizes == expected.sizes


def test_it_is_a_copy(tiny_store, tmp_path):
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
def test_on_a_gpu(any_store, draw_plan, same_bits, fields):
    device, windows = torch.device("cuda"), Windows(4, 40, 5)
    wanted = [*draw_plan(any_store, 6), *cut_batches(np.arange(any_store.ticks), 32)]
    resident = DeviceStore(any_store, fields, device)
    with Prefetch(any_store, wanted, windows, device, resident=resident) as batches:
        kept = [*batches]
    for draw, batch in kept:
        assert batch.features.is_cuda and batch.sensor.is_cuda
        expected = any_store.gather(draw.ticks, 4, 40, 5, variants=draw.variants)
        assert same_bits(batch, expected)


def test_auto_takes_a_gpu_that_has_room_for_all(store):
    fields, line = choose_feed("auto", store, CUDA, free=2**30)
    assert fields == ALL
    assert line.startswith("feed: device (auto; ") and "free on cuda" in line
    largest = store.array("sensor/values").nbytes
    fields, line = choose_feed("auto", store, CUDA, free=largest)
    assert not fields
    assert line.startswith("feed: mapped (auto: ")


def test_device_takes_what_fits_the_smallest_first(store, tiny_store, tmp_path):
    sizes = {name: store.gatherer.tensor(name).nbytes for name in ALL}
    largest = max(sizes, key=lambda name: sizes[name])
    free = int((sum(sizes.values()) - 1) / 0.6)
    assert choose_feed("device", store, CPU, free)[0] == ALL - {largest}
    assert choose_feed("device", store, CPU, 0)[0] == frozenset()
    assert choose_feed("device", store, CPU)[0] == ALL
    lacking = FeatureStore.open(tiny_store(tmp_path, sensor_channels=0))
    assert choose_feed("device", lacking, CPU)[0] == ALL - {"sensor"}, "it needs no room"


def test_a_run_with_another_feed_continues_bit_for_bit(store, params, trainer, tmp_path, stop_at):
    whole = trainer(store, params(feed="mapped", output=tmp_path / "whole"))
    whole.fit()
    stop_at(trainer(store, params(feed="mapped")), 11)
    again = trainer(store, params(feed="device"))
    assert (again.run.status, again.step) == ("resumed", 10)
    again.fit()
    for name, value in weights(whole).items():
        assert torch.equal(weights(again)[name], value), name


def weights(trainer: Trainer) -> dict[str, torch.Tensor]:
    averaged = {f"average {name}": value for name, value in trainer.average.weights.items()}
    return {**trainer.learning, **averaged}
