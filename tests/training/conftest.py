"""A small store and a policy of a few thousand parameters that trains in a second."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from pipeline.config import TrainHeadParams
from pipeline.sampling import split_by_episode
from pipeline.store import FeatureStore
from pipeline.training import Trainer, open_run

SMALL: dict[str, Any] = {
    "sensor_encoder": {"channels": [8, 8], "layers": 1, "heads": 2, "output_dim": 8},
    "state_encoder": {"dim": 8, "layers": 1, "heads": 2, "output_dim": 8},
    "expert": {"dim": 16, "layers": 1, "heads": 2, "dropout": 0.1},
    "horizon": 3,
    "sensor_window": 6,
    "state_window": 5,
    "batch_size": 8,
    "max_steps": 20,
    "warmup_steps": 4,
    "lr": 3e-3,
    "ema_decay": 0.9,
    "eval_every": 8,
    "checkpoint_every": 5,
    "device": "cpu",
    "mixture": {"left": 1.0, "right": 2.0},
}


@pytest.fixture(scope="session")
def store(
    tiny_store: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory
) -> FeatureStore:
    return FeatureStore.open(tiny_store(tmp_path_factory.mktemp("training")))


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Sums over several threads are taken in another order, so that bits differ."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def params(tmp_path: Path) -> Callable[..., TrainHeadParams]:
    """`params(key=value, ...)`: small params that work below the test's folder."""

    def make(**changed: Any) -> TrainHeadParams:
        places = {"output": tmp_path / "head", "logs": tmp_path / "logs"}
        return TrainHeadParams.model_validate(SMALL | places | changed)

    return make


@pytest.fixture
def trainer() -> Callable[[FeatureStore, TrainHeadParams], Trainer]:
    """A trainer that begins anew or goes on with what lies at the params' output."""

    def make(store: FeatureStore, params: TrainHeadParams) -> Trainer:
        split = split_by_episode(store, params.val_fraction, params.horizon)
        return Trainer(store, params, split, open_run(params, store))

    return make
