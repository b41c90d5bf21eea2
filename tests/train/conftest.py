"""A small store and a policy of a few thousand parameters that trains in a second."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from pipeline.base.config import TrainHeadParams
from pipeline.store import FeatureStore
from pipeline.train.loop import Trainer
from pipeline.train.run import open_run
from pipeline.train.split import split_by_episode

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


@pytest.fixture(scope="session")
def params_below() -> Callable[..., TrainHeadParams]:
    """`params_below(folder, key=value, ...)`: small params that work below this folder."""

    def make(folder: Path, **changed: Any) -> TrainHeadParams:
        places = {"output": folder / "head", "logs": folder / "logs"}
        return TrainHeadParams.model_validate(SMALL | places | changed)

    return make


@pytest.fixture
def params(
    params_below: Callable[..., TrainHeadParams], tmp_path: Path
) -> Callable[..., TrainHeadParams]:
    """`params(key=value, ...)`: small params that work below the test's folder."""
    return partial(params_below, tmp_path)


@pytest.fixture(scope="session")
def trainer() -> Callable[[FeatureStore, TrainHeadParams], Trainer]:
    """A trainer that begins anew or goes on with what lies at the params' output."""

    def make(store: FeatureStore, params: TrainHeadParams) -> Trainer:
        split = split_by_episode(store, params.val_fraction, params.horizon)
        return Trainer(store, params, split, open_run(params, store))

    return make
