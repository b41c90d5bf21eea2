"""Which way batches are made, and what is said of it."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from pipeline.store import FeatureStore
from pipeline.train.batches import choose_feed

CPU, CUDA = torch.device("cpu"), torch.device("cuda")
ALL = {"features", "sensor", "state", "action"}


@pytest.fixture(scope="module")
def path(tiny_store: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_store(tmp_path_factory.mktemp("choice"))


@pytest.fixture(scope="module")
def store(path: Path) -> FeatureStore:
    return FeatureStore.open(path)


class TestChoice:
    def test_auto_on_the_cpu_is_the_map(self, store: FeatureStore) -> None:
        chosen = choose_feed("auto", store, CPU)
        assert (chosen.feed, chosen.on_device) == ("mapped", frozenset())
        assert chosen.why == "feed: mapped (auto: training runs on the cpu)"

    def test_auto_takes_a_gpu_that_has_room_for_all(self, store: FeatureStore) -> None:
        chosen = choose_feed("auto", store, CUDA, free=2**30)
        assert (chosen.feed, chosen.on_device) == ("device", ALL)
        assert "auto" in chosen.why and "free on cuda" in chosen.why

    def test_auto_leaves_a_gpu_that_has_not(self, store: FeatureStore) -> None:
        largest = store.array("sensor/values").nbytes
        chosen = choose_feed("auto", store, CUDA, free=largest)
        assert (chosen.feed, chosen.on_device) == ("mapped", frozenset())

    def test_device_takes_what_fits_the_smallest_first(self, store: FeatureStore) -> None:
        sizes = {name: store.tensor(name).nbytes for name in ALL}
        largest = max(sizes, key=lambda name: sizes[name])
        free = int((sum(sizes.values()) - 1) / 0.6)
        assert choose_feed("device", store, CPU, free).on_device == ALL - {largest}
        assert choose_feed("device", store, CPU, 0).on_device == frozenset()
        assert choose_feed("device", store, CPU).on_device == ALL

    def test_a_stream_that_is_not_there_needs_no_room(
        self, tiny_store: Callable[..., Path], tmp_path: Path
    ) -> None:
        lacking = FeatureStore.open(tiny_store(tmp_path, sensor_channels=0))
        assert choose_feed("device", lacking, CPU).on_device == ALL - {"sensor"}

    def test_what_is_asked_for_is_said(self, store: FeatureStore) -> None:
        for feed in ("mapped", "device"):
            chosen = choose_feed(feed, store, CPU)
            assert chosen.feed == feed
            assert chosen.why.startswith(f"feed: {feed}")
            assert "train_head.feed" in chosen.why
