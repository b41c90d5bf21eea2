"""A small store and a policy of a few thousand parameters that trains in a second."""

from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zarr

from pipeline.base.config import TrainHeadParams
from pipeline.store import FeatureStore
from pipeline.store.chunks import write_seal
from pipeline.train.loop import Trainer
from pipeline.train.run import open_run
from pipeline.train.split import split_by_episode

SMALL: dict[str, Any] = {
    "sensor_encoder": {"channels": [8, 8], "layers": 1, "heads": 2, "output_dim": 8},
    "state_encoder": {"dim": 8, "layers": 1, "heads": 2, "output_dim": 8},
    "expert": {"dim": 16, "layers": 1, "heads": 2, "dropout": 0.1},
    "horizon": 3,
    "max_steps": 20,
    "warmup_steps": 4,
    "lr": 3e-3,
    "ema_decay": 0.9,
    "eval_every": 8,
    "checkpoint_every": 5,
    "mixture": {"left": 1.0, "right": 2.0},
}


@pytest.fixture(scope="session")
def store(tiny_store, tmp_path_factory):
    return FeatureStore.open(tiny_store(tmp_path_factory.mktemp("training")))


@pytest.fixture(scope="session")
def store_saying(tiny_store):
    """`store_saying(folder, entries, key=value, ...)`: a tiny store with these entries in sections
    of its attributes."""

    def make(folder: Path, entries: dict[str, dict[str, Any]], **changed: Any) -> FeatureStore:
        path = tiny_store(folder, **changed)
        attrs = zarr.open_group(path, mode="r+").attrs
        known: dict[str, Any] = attrs.asdict()
        attrs.update({section: known.get(section, {}) | more for section, more in entries.items()})
        write_seal(path)
        return FeatureStore.open(path)

    return make


@pytest.fixture(scope="session")
def params_below(tiny_head):
    """`params_below(folder, key=value, ...)`: small params that work below this folder."""

    def make(folder: Path, **changed: Any) -> TrainHeadParams:
        return TrainHeadParams.model_validate(tiny_head(folder, **SMALL | changed))

    return make


@pytest.fixture
def params(params_below, tmp_path):
    """`params(key=value, ...)`: small params that work below the test's folder."""
    return partial(params_below, tmp_path)


@pytest.fixture(scope="session")
def trainer():
    """A trainer that begins anew or goes on with what lies at the params' output."""

    def make(store: FeatureStore, params: TrainHeadParams) -> Trainer:
        split = split_by_episode(store, params.split, params.horizon)
        return Trainer(store, params, split, open_run(params, store))

    return make


class Stop(Exception):
    """Stands for the end of the process."""


@pytest.fixture
def stop_at(monkeypatch):
    """`stop_at(trainer, step)`: train until this step has begun, and end as a kill does.

    Where `step` is None, the kill comes before the finished run is renamed.
    """
    real = Trainer._train_step

    def stop(trainer: Trainer, step: int | None) -> None:
        def killed(self: Trainer, *rest: Any) -> None:
            if self.step == step:
                raise Stop
            real(self, *rest)

        def killed_at_the_end(*rest: object) -> None:
            raise Stop

        with monkeypatch.context() as patched:
            patched.setattr(Trainer, "_train_step", killed)
            if step is None:
                patched.setattr("pipeline.train.run.TrainingRun.finish", killed_at_the_end)
            with pytest.raises(Stop):
                trainer.fit()

    return stop
