"""The rules do what they are named after, fitted on training ticks alone."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.evaluate import baselines as rules
from pipeline.evaluate.baselines import BASELINES, METHODS, Baselines, recorded_chunks
from pipeline.policy.normalization import ChannelStatistics
from pipeline.store import FeatureStore

Make = Callable[..., Any]

TRAIN = np.arange(90, 180)
ABSOLUTE = {"kind": "absolute"}


def statistics(store: FeatureStore) -> ChannelStatistics:
    values = store.array("vl/features").astype(np.float64)
    return ChannelStatistics(values.mean(0), values.std(0), len(values))


def test_each_rule_by_hand(store: FeatureStore) -> None:
    action = store.array("tick/action")
    ticks = np.array([0, 1, 29, 30, 31])
    found = Baselines(store, TRAIN, 4, statistics(store)).act(ticks)
    assert tuple(found) == BASELINES and ("policy", *BASELINES) == METHODS
    assert np.array_equal(found["zero_action"], np.zeros((5, 1, 5)))
    median = np.median(action[TRAIN], axis=0)
    assert np.array_equal(found["median_action"], np.tile(median, (5, 1, 1)))
    nothing = np.zeros(5)
    # Ticks 0 and 30 begin episodes: what the other episode did last is not theirs to repeat.
    expected = [nothing, action[0], action[28], nothing, action[30]]
    assert np.array_equal(found["repeat_last"][:, 0], expected)
    assert found["linear_fit"].shape == found["nearest_neighbour"].shape == (5, 4, 5)


def test_absolute_actions_are_not_repeated_from_nothing(store, monkeypatch):
    absolute = store.streams | {"action": store.streams["action"] | ABSOLUTE}
    monkeypatch.setattr(FeatureStore, "streams", absolute)
    action = store.array("tick/action")
    found = Baselines(store, TRAIN, 1, None).act(np.array([0, 1, 30]))["repeat_last"][:, 0]
    median = np.median(action[TRAIN], axis=0)
    assert np.array_equal(found, [median, action[0], median])


def test_the_linear_fit_continues_what_is_linear(tiny_store: Make, tmp_path: Path) -> None:
    """Each action is 1.5 times the last less 0.6 times the one before, plus 0.1: so is its fit."""
    store = FeatureStore.open(tiny_store(tmp_path, episodes=12))
    action = store.array("tick/action")
    rng = np.random.default_rng(0)
    for first in range(0, 360, 30):
        action[first : first + 2] = rng.normal(size=(2, 5))
        for tick in range(first + 2, first + 30):
            action[tick] = 1.5 * action[tick - 1] - 0.6 * action[tick - 2] + 0.1
    inside = np.concatenate([np.arange(first + 2, first + 27) for first in range(0, 360, 30)])
    held_out, train = inside[inside < 60], inside[inside >= 60]
    linear = Baselines(store, train, 4, None).act(held_out)["linear_fit"]
    recorded, valid = recorded_chunks(store, held_out, 4)
    assert valid.all()
    np.testing.assert_allclose(linear, recorded, atol=1e-4)


def test_a_joint_that_stands_elsewhere_does_not_upset_the_linear_fit(
    tiny_store, tmp_path, monkeypatch
):
    """It stands still in the training episodes, but for rounding, and elsewhere in the others."""
    store = FeatureStore.open(tiny_store(tmp_path))
    joints = {"names": [f"joint_{joint}" for joint in range(5)], "units": ["rad"] * 5}
    monkeypatch.setattr(FeatureStore, "streams", store.streams | {"action": joints | ABSOLUTE})
    action = store.array("tick/action")
    action[:, 4] = 0.05 + 1e-6 * np.random.default_rng(0).standard_normal(store.ticks)
    action[:60, 4] = -0.09
    linear = Baselines(store, TRAIN, 4, None).act(np.arange(2, 30))["linear_fit"]
    assert np.abs(linear).max() < 2 * np.abs(action).max()


@pytest.mark.parametrize("width", [3, 256])
def test_the_nearest_neighbour_of_a_training_tick_is_itself(store, monkeypatch, width):
    monkeypatch.setattr(rules, "_WIDTH", width)
    monkeypatch.setattr(rules, "_ROWS", 7)
    found = Baselines(store, TRAIN, 4, statistics(store)).act(TRAIN)["nearest_neighbour"]
    assert np.array_equal(found, recorded_chunks(store, TRAIN, 4)[0])


def test_state_and_features_both_decide_who_is_near(tiny_store: Make, tmp_path: Path) -> None:
    store = FeatureStore.open(tiny_store(tmp_path))
    row, end = store.array("tick/vl_row"), store.array("tick/state_end")
    store.array("state/values")[:] = 0
    store.array("vl/features")[:] = 0
    seen, alike, near = 0, 95, 130
    store.array("state/values")[end[[seen, alike]] - 1] = 1
    store.array("vl/features")[row[[seen, near]]] = 5
    scale = ChannelStatistics(np.zeros((3, 8)), np.ones((3, 8)), 1)
    assert rules.Neighbours(store, TRAIN, None).nearest(np.array([seen])) == [alike]
    store.array("state/values")[:] = 0
    by_features = rules.Neighbours(store, TRAIN, scale).nearest(np.array([seen]))
    assert by_features is not None and row[by_features] == row[near]


def test_an_angle_is_near_where_it_is_written_a_turn_further(tiny_store, tmp_path, monkeypatch):
    store = FeatureStore.open(tiny_store(tmp_path))
    pose = {"names": ["pose_a", "pose_b", "pose_r", "joint_1"], "units": ["deg"] * 4}
    monkeypatch.setattr(FeatureStore, "streams", store.streams | {"state": pose})
    newest = store.array("tick/state_end") - 1
    store.array("state/values")[newest] = np.linspace(-170, 150, 180)[:, None]
    store.array("state/values")[newest[0]] = [100 + 360, 100, 100 - 360, 100]
    nearest = rules.Neighbours(store, TRAIN, None).nearest(np.array([0]))
    at = np.abs(store.array("state/values")[newest[TRAIN], 0] - 100)
    assert nearest is not None and nearest[0] == TRAIN[at.argmin()]


@pytest.mark.parametrize("state_dim", [0, 4])
def test_a_stream_that_is_missing_leaves_the_other_or_the_median(tiny_store, tmp_path, state_dim):
    store = FeatureStore.open(tiny_store(tmp_path, state_dim=state_dim))
    found = Baselines(store, TRAIN, 2, None).act(TRAIN)
    if state_dim:
        neighbours = rules.Neighbours(store, TRAIN, None)
        store.array("tick/state_end")[:30] = store.array("episode/state_start")[0]
        nearest = neighbours.nearest(np.arange(30))
        assert nearest is not None and len(set(nearest.tolist())) == 1, "all stand at the mean"
        assert np.array_equal(found["nearest_neighbour"], recorded_chunks(store, TRAIN, 2)[0])
    else:
        assert np.array_equal(found["nearest_neighbour"], found["median_action"])
