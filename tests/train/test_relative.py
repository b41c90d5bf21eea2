"""A policy of absolute actions that learns them relative to the state."""

import shutil

import numpy as np
import pytest

from pipeline.base.errors import ConfigError
from pipeline.policy.checkpoint import find_policy, load_policy
from pipeline.store import FeatureStore
from pipeline.train.split import split_by_episode

NAMES = ["joint_0", "joint_1", "joint_2", "joint_3", "gripper"]


@pytest.fixture(scope="module")
def absolute(store_saying, reseal, tmp_path_factory):
    """The tiny store with targets of joints that lie near where the joints are, far from zero."""
    joints = {"names": NAMES, "units": [""] * 5, "kind": "absolute"}
    store = store_saying(tmp_path_factory.mktemp("absolute"), {"streams": {"action": joints}})
    path = store.path
    action = np.memmap(path / "tick/action/c/0/0", np.float32, "r+", shape=(store.ticks, 5))
    values = path / "state/values/c/0/0"
    state = np.memmap(values, np.float32, "r+", shape=store.array("state/values").shape)
    state *= 100  # a joint is anywhere, and its targets are close to it
    action[:, :4] = state[store.array("tick/state_end") - 1] + 0.1 * action[:, :4]
    action.flush()
    state.flush()
    reseal(path)
    return FeatureStore.open(path)


def test_relative_actions_are_learned_better_and_answered_as_they_were(
    absolute, params, trainer, tmp_path
):
    errors = {}
    for form in ("recorded", "relative"):
        wanted = params(output=tmp_path / form, logs=tmp_path / f"{form}-logs", action_form=form)
        trainer(absolute, wanted).fit()
        checkpoint = load_policy(find_policy(tmp_path / form))
        assert len(checkpoint.shape.relative) == (4 if form == "relative" else 0)
        split = split_by_episode(absolute, wanted.split, wanted.horizon)
        batch = absolute.gather(split.test, wanted.horizon, 6, 5)
        chunk = checkpoint.policy().act(batch)
        errors[form] = float((chunk - batch.action)[:, 0, :4].abs().mean())
    assert errors["relative"] < 0.05 * errors["recorded"]


def test_statistics_of_the_recorded_actions_stay(absolute, params, trainer, tmp_path):
    """Errors are divided by them, so policies of both forms compare."""
    relative = trainer(absolute, params(action_form="relative")).normalization
    recorded = trainer(absolute, params(output=tmp_path / "other")).normalization
    assert np.array_equal(relative.action.std, recorded.action.std)
    assert recorded.relative is None and relative.relative.mean.shape == (5,)


def test_a_joint_that_stands_elsewhere_in_val_does_not_choose_the_checkpoint(
    absolute, params, trainer, reseal, tmp_path
):
    path = shutil.copytree(absolute.path, tmp_path / "still.zarr")
    val = split_by_episode(absolute, params().split, params().horizon).val
    action = np.memmap(path / "tick/action/c/0/0", np.float32, "r+", shape=(absolute.ticks, 5))
    action[:, 3] = 0.05 + 1e-6 * np.random.default_rng(0).standard_normal(absolute.ticks)
    action[val, 3] = -0.09
    action.flush()
    reseal(path)
    done = trainer(FeatureStore.open(path), params())
    done.fit()
    assert done.stopping.best_error < 10


def test_a_tick_without_a_state_is_named(absolute, params, trainer, reseal, tmp_path):
    path = shutil.copytree(absolute.path, tmp_path / "holes.zarr")
    ends = np.memmap(path / "tick/state_end/c/0", np.int64, "r+", shape=(absolute.ticks,))
    ends[:30] = 0  # of the first episode
    ends.flush()
    reseal(path)
    with pytest.raises(ConfigError, match=r"episode_000"):
        trainer(
            FeatureStore.open(path), params(action_form="relative", split={"test": 0, "val": 0})
        )
