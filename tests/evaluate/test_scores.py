"""Errors and baselines against values worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.evaluate.baselines import BASELINES
from pipeline.evaluate.figures import rivalry
from pipeline.train.predictions import Predictions
from pipeline.train.scores import ActionGroup, Comparison, compare


def test_errors_worked_out_by_hand() -> None:
    recorded = np.zeros((2, 2, 2), np.float32)
    predicted = np.array([[[1, 10], [3, 20]], [[5, 30], [99, 99]]], np.float32)
    predictions = Predictions(
        ticks=np.array([4, 9]),
        episodes=np.array([2, 7]),
        predicted=predicted,
        recorded=recorded,
        valid=np.array([[True, True], [True, False]]),  # the second chunk leaves its episode
    )
    groups = (ActionGroup("both", "mm", (0, 1)),)
    rules = {name: np.full((2, 1, 2), 30, np.float32) for name in BASELINES}
    rules["repeat_last"] = np.full((2, 1, 2), -13, np.float32)
    space = (("x", "y"), ("mm", "mm"), groups, np.array([2.0, 10.0]))
    found = compare(predictions, rules, space)
    score = found.scores["policy"]
    assert found.episodes == (2, 7)
    assert score.mae == pytest.approx([3, 20])
    assert score.mae_horizon == pytest.approx(np.array([[3, 20], [3, 20]]))
    assert score.mae_episode == pytest.approx(np.array([[2, 15], [5, 30]]))
    assert found.error("policy", groups[0]) == pytest.approx(11.5)
    assert found.overall("policy") == pytest.approx((3 / 2 + 20 / 10) / 2)
    assert found.executed.error("policy", groups[0]) == pytest.approx(11.5)
    assert found.part(steps=slice(1, 2)).error("policy") == pytest.approx((3 / 2 + 20 / 10) / 2)
    assert found.ticks == 2 and found.cells.group.tolist() == ["2", "7"]
    assert rivalry(found, groups[0]).ratio == pytest.approx(11.5 / 13)
    assert rivalry(found).ratio == pytest.approx(1.75 / ((13 / 2 + 13 / 10) / 2))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), ticks=st.integers(1, 12), horizon=st.integers(1, 4))
def test_what_lies_beyond_an_episode_changes_no_score(seed: int, ticks: int, horizon: int) -> None:
    rng = np.random.default_rng(seed)
    shape = (ticks, horizon, 3)
    valid = np.arange(horizon) < rng.integers(1, horizon + 1, (ticks, 1))
    clean = rng.normal(size=shape).astype(np.float32)
    dirty = np.where(valid[..., None], clean, np.float32(1e9))
    groups = (ActionGroup("all", "", (0, 1, 2)),)
    scores = []
    for predicted in (clean, dirty):
        predictions = Predictions(
            np.arange(ticks), np.arange(ticks) // 3, predicted, np.zeros(shape, np.float32), valid
        )
        found = compare(predictions, {}, (("a", "b", "c"), ("", "", ""), groups, np.ones(3)))
        scores.append(found.scores["policy"])
    for name in ("mae", "mae_horizon", "mae_episode"):
        assert np.array_equal(getattr(scores[0], name), getattr(scores[1], name), equal_nan=True)


def test_a_group_that_never_varies_is_not_compared_and_weighs_nothing(recorded, compared):
    error = np.array([0, 0, 0, 0, 5.0])
    comparison = compared(recorded(np.arange(60), error))
    gripper = comparison.groups[2]
    assert rivalry(comparison, gripper).ratio is None
    assert comparison.error("policy", gripper) == pytest.approx(5.0)
    assert comparison.overall("policy") == pytest.approx(0.0, abs=1e-6)


def joints(comparison: Comparison, scale: list[float]) -> Comparison:
    """The comparison of five dimensions as if they were joints of these training deviations."""
    names = tuple(f"joint_{index}" for index in range(5))
    return replace(comparison, names=names, units=("rad",) * 5, scale=np.array(scale))


def test_what_hardly_moves_beside_its_like_is_told_and_can_be_left_out(recorded, compared):
    """By the yardstick of `stages.inspect`: a hundredth of the upper quartile of three or more."""
    error = np.array([0.1, 0.1, 0.1, 0.001, 0.001])
    found = joints(compared(recorded(np.arange(60), error)), [1.0, 1.0, 1.0, 0.0099, 0.0101])
    assert found.low_variance() == {3: 1.0}
    assert joints(found, [1.0, 1.0, 0.001, 0.001, 0.001]).low_variance().keys() == {2, 3, 4}
    assert found.overall("policy") == pytest.approx((0.3 + 1 / 9.9 + 1 / 10.1) / 5, rel=1e-4)
    moving = found.without_low_variance()
    assert moving.overall("policy") == pytest.approx((0.3 + 1 / 10.1) / 4, rel=1e-4)
    assert moving.varying() == [0, 1, 2, 4] and found.varying() == [0, 1, 2, 3, 4]
