"""One recorded episode, the store of it and a head that was trained on that for a moment."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline.base.config import Params
from pipeline.extract.run import extract
from pipeline.policy.checkpoint import PolicyCheckpoint, find_policy, load_policy
from pipeline.simulation.insertion_formats import write_raw
from pipeline.simulation.recorder import simulate_episode
from pipeline.store import FeatureStore
from pipeline.train.loop import Trainer
from pipeline.train.run import open_run
from pipeline.train.split import split_by_episode


@pytest.fixture(scope="package")
def params(
    tmp_path_factory: pytest.TempPathFactory,
    demo_checkpoint: Path,
    tiny_head: Callable[..., dict[str, Any]],
) -> Params:
    """Params of one recorded episode, whose store is extracted."""
    root = tmp_path_factory.mktemp("live")
    write_raw(root / "raw" / "Red_point", simulate_episode(5, 1.7e9))
    vlm = {
        "checkpoint": str(demo_checkpoint),
        "image_resize_height": 56,
        "image_resize_width": 84,
        "dtype": "float32",
        "pooling": ["mean", "grid"],
    }
    document = {
        "data": {"root": str(root), "sources": [{"name": "raw", "path": "raw"}]},
        "vlm": vlm,
        "extract": {"store": str(root / "store.zarr")},
        "train_head": tiny_head(root),
    }
    params = Params.model_validate(document)
    extract(params, say=lambda _: None)
    return params


@pytest.fixture(scope="package")
def head(params: Params) -> Path:
    """The output of a training of a few steps."""
    wanted, store = params.train_head, FeatureStore.open(params.extract.store)
    split = split_by_episode(store, wanted.split, wanted.horizon)
    Trainer(store, wanted, split, open_run(wanted, store)).fit()
    return wanted.output


@pytest.fixture(scope="package")
def checkpoint(head: Path) -> PolicyCheckpoint:
    """The policy of that training."""
    return load_policy(find_policy(head))
