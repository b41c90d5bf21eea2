"""Predictions over a small store, without a policy."""

from collections.abc import Callable

import numpy as np
import pytest

from pipeline.evaluate.baselines import Baselines
from pipeline.store import FeatureStore
from pipeline.train.predictions import Predictions
from pipeline.train.scores import ActionGroup, Comparison, compare

GROUPS = (
    ActionGroup("translation", "mm", (0, 1, 2)),
    ActionGroup("rotation", "deg", (3,)),
    ActionGroup("gripper", "", (4,)),
)


@pytest.fixture(scope="session")
def store(tiny_store, tmp_path_factory) -> FeatureStore:
    return FeatureStore.open(tiny_store(tmp_path_factory.mktemp("evaluation")))


@pytest.fixture
def recorded(store: FeatureStore) -> Callable[..., Predictions]:
    """`recorded(ticks, error=0)`: a policy that does what was recorded, plus `error`."""

    def make(ticks: np.ndarray, error: float | np.ndarray = 0.0, horizon: int = 4) -> Predictions:
        batch = store.gather(ticks, horizon=horizon)
        action = batch.action.numpy()
        return Predictions(
            ticks=ticks,
            episodes=ticks // 30,
            predicted=(action + error).astype(np.float32),
            recorded=action,
            valid=batch.action_valid.numpy(),
        )

    return make


@pytest.fixture
def compared(store: FeatureStore) -> Callable[[Predictions], Comparison]:
    """The comparison of predictions with the baselines, statistics over the whole store."""

    def make(predictions: Predictions) -> Comparison:
        action = store.array("tick/action").astype(np.float64)
        spread = np.where(action.std(0) > 1e-9, action.std(0), 0)
        rules = Baselines(store, np.arange(90, 180), predictions.recorded.shape[1], None)
        named = (tuple(store.streams["action"][key]) for key in ("names", "units"))
        return compare(predictions, rules.act(predictions.ticks), (*named, GROUPS, spread))

    return make
