"""Stores of every kind that a feed has to show alike."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zarr

from pipeline.store import Batch, FeatureStore
from pipeline.train.batches import BatchIndices

KINDS = ("plain", "bfloat16", "variants", "no sensor", "no state")


@pytest.fixture(scope="session", params=KINDS)
def any_store(
    request: pytest.FixtureRequest,
    tiny_store: Callable[..., Path],
    tmp_path_factory: pytest.TempPathFactory,
) -> FeatureStore:
    """Small stores that differ in what they hold, some rows of two variants among them."""
    folder, kind = tmp_path_factory.mktemp("kinds"), request.param
    changed = {
        "bfloat16": {"dtype": "bfloat16"},
        "variants": {"slots": 6},
        "no sensor": {"sensor_channels": 0},
        "no state": {"state_dim": 0},
    }
    path = tiny_store(folder, **changed.get(kind, {}))
    if kind == "variants":
        spec = {"digest": "two", "variants": 2}
        zarr.open_group(path, mode="r+").attrs["feature_spec"] = spec
    return FeatureStore.open(path)


@pytest.fixture(scope="session")
def draw_plan() -> Callable[..., list[BatchIndices]]:
    """`draw_plan(store, batches, size=7)`: random ticks of random variants."""

    def make(store: FeatureStore, batches: int, size: int = 7) -> list[BatchIndices]:
        rng = np.random.default_rng(0)
        return [
            BatchIndices(rng.integers(0, store.ticks, size), rng.integers(0, store.variants, size))
            for _ in range(batches)
        ]

    return make


@pytest.fixture(scope="session")
def same_bits() -> Callable[[Batch, Batch], bool]:
    """Whether two batches are equal to the bit, in shape and in dtype."""

    def compare(one: Batch, other: Batch) -> bool:
        return all(
            value.dtype == getattr(other, name).dtype
            and value.shape == getattr(other, name).shape
            and value.cpu().numpy(force=True).tobytes() == getattr(other, name).numpy().tobytes()
            if value.dtype.is_floating_point and value.element_size() > 2
            else value.cpu().equal(getattr(other, name))
            for name, value in vars(one).items()
        )

    return compare
