"""What a training says before it begins."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.store import FeatureStore
from pipeline.train.progress import describe_data
from pipeline.train.run import policy_shape
from pipeline.train.split import Split, split_by_episode
from pipeline.train.statistics import fit_normalization

Make = Callable[..., Any]


@pytest.fixture
def warnings(store: FeatureStore, params: Make) -> Callable[..., list[str]]:
    """`warnings(train, key=value, ...)`: of a training on these ticks, the others held out."""

    def found(train: np.ndarray, absent: dict[str, int] | None = None, **head: Any) -> list[str]:
        held_out = np.setdiff1d(np.arange(store.ticks), train)
        shape = policy_shape(store, fit_normalization(store, train))
        split = Split(train, held_out, (), None)
        return describe_data(store, replace(shape, **(absent or {})), params(**head), split)[1]

    return found


def test_nothing_is_said_where_every_source_and_stream_is_trained_on(
    store: FeatureStore, warnings: Make
) -> None:
    assert warnings(split_by_episode(store, 0.3).train) == []


def test_a_source_without_a_training_episode_is_named_with_the_way_out(warnings: Make) -> None:
    """Episodes of 30 ticks: left, right, left, …"""
    (line,) = warnings(np.arange(30), val_fraction=0.4)
    assert line.startswith("warning: source 'right'")
    assert "train_head.val_fraction 0.4" in line
    assert warnings(np.arange(30), mixture={"right": 0.0}) == [], "the user wants it so"


def test_a_stream_that_no_training_episode_has_is_named(
    store: FeatureStore, warnings: Make
) -> None:
    train, absent = np.arange(store.ticks), {"sensor_channels": 0}
    (line,) = warnings(train, absent)
    assert line.startswith("warning: sensor")
    assert "train_head.val_fraction" in line
    assert warnings(train, absent, sensor_enabled=False) == []


def test_a_training_says_it_last_before_it_begins(
    tiny_store: Make, trainer: Make, params: Make, tmp_path: Path
) -> None:
    """Of two recordings one is held out, and with it its source."""
    two = FeatureStore.open(tiny_store(tmp_path, episodes=2))
    *_, last = trainer(two, params()).summary()
    assert last.startswith("warning: source ")
