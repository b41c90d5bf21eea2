"""Figures and their intervals: paired where they are compared, none where there is nothing."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.evaluate.baselines import BASELINES
from pipeline.evaluate.figures import (
    Figure,
    best_baseline,
    bootstrap_means,
    error,
    mean_over_ticks,
    rivalry,
    times,
)
from pipeline.train.predictions import Predictions
from pipeline.train.scores import ActionGroup, Comparison, compare

GROUPS = 12


def compared(policy: np.ndarray, rule: np.ndarray, groups: int = GROUPS, **more) -> Comparison:
    """`policy` and `rule` (episode, step) are errors of one dimension at ten ticks an episode."""
    episodes = np.repeat(np.arange(len(policy)), 10)
    shape = (len(episodes), policy.shape[1], 1)
    recorded = np.zeros(shape, np.float32)

    def acted(errors: np.ndarray) -> np.ndarray:
        return np.repeat(errors, 10, axis=0)[..., None].astype(np.float32)

    rules = dict.fromkeys(BASELINES, acted(rule + 1)) | {"linear_fit": acted(rule)}
    predictions = Predictions(
        np.arange(len(episodes)), episodes, acted(policy), recorded, np.ones(shape[:2], bool)
    )
    names = (episodes % groups).astype(np.str_)
    one = (ActionGroup("translation", "mm", (0,)),)
    space = (("x",), ("mm",), one, np.array([2.0]))
    return compare(predictions, rules, space, names, **more)


def errors(mean: float, seed: int = 0, spread: float = 0.3) -> np.ndarray:
    return mean + spread * np.random.default_rng(seed).random((GROUPS, 2))


def test_an_interval_holds_its_value_and_is_of_groups_not_of_ticks() -> None:
    figure = error(compared(errors(1.0), errors(1.0, 1)), "policy")
    assert figure.low < figure.value < figure.high
    assert figure.value == pytest.approx(errors(1.0).mean() / 2)
    wider = error(compared(errors(1.0), errors(1.0, 1), groups=2), "policy")
    assert wider.value == figure.value and (wider.low, wider.high) != (figure.low, figure.high)


def test_what_both_err_on_alike_is_resolved_by_the_pairs() -> None:
    """Each alone spreads by far more than they differ."""
    hard = errors(1.0, spread=3.0)
    found = compared(hard + 0.05, hard)
    apart = rivalry(found)
    assert apart.best == "linear_fit" and apart.verdict == "worse"
    assert apart.difference.value == pytest.approx(0.025, rel=1e-3)
    assert apart.policy.low < apart.baseline.high
    assert rivalry(compared(hard - 0.05, hard)).verdict == "better"
    noise = np.random.default_rng(5).normal(0, 0.3, hard.shape)
    assert rivalry(compared(hard + noise - noise.mean(), hard)).verdict == "not resolved"


def test_the_best_baseline_is_the_best_at_that_very_figure() -> None:
    rule = np.tile([0.1, 9.0], (GROUPS, 1))
    found = compared(errors(1.0), rule)
    scores = {**found.scores, "zero_action": replace(found.scores["policy"])}
    found = replace(found, scores=scores)
    assert best_baseline(found.executed) == "linear_fit"
    assert best_baseline(found) == "zero_action"


def test_one_group_has_no_interval_and_nothing_is_resolved() -> None:
    found = compared(errors(1.0), errors(2.0), groups=1)
    figure, apart = error(found, "policy"), rivalry(found)
    assert (figure.low, figure.high) == (None, None)
    assert apart.difference.low is None and apart.verdict == "no interval"
    assert figure.text() == f"{figure.value:.3f}"


def test_a_ratio_of_the_same_ticks_is_paired() -> None:
    hard = errors(1.0, spread=3.0)
    found = times(compared(1.2 * hard, hard), compared(hard, hard))
    assert (found.value, found.low, found.high) == pytest.approx((1.2, 1.2, 1.2), rel=1e-5)
    assert times(compared(hard, hard), compared(0 * hard, hard)) is None


def test_figures_read_alike() -> None:
    for figure, sign, text in (
        (Figure(0.27891, 0.25, 0.3049), "", "0.279 (0.250–0.305)"),
        (Figure(-0.01234, -0.05, 0.021), "+", "-0.0123 (-0.0500 to +0.0210)"),
        (Figure(12.34), "", "12.3"),
        (Figure(0.0), "", "0"),
        (Figure(float("nan")), "", "–"),
    ):
        assert figure.text(sign) == text


def test_a_mean_over_ticks_weighs_ticks_and_draws_groups() -> None:
    figure = mean_over_ticks(np.array([1.0, 1.0, 4.0]), np.array(["a", "a", "b"]))
    assert (figure.value, figure.low, figure.high) == (2.0, 1.0, 4.0)


def test_a_draw_is_the_ratio_of_its_sums_so_long_groups_weigh_more() -> None:
    sums, counts = np.array([[2.0], [90.0]]), np.array([[1.0], [10.0]])
    draws = bootstrap_means(sums, counts, 400)
    assert {round(float(value), 9) for value in draws[:, 0]} == {2.0, round(92 / 11, 9), 9.0}


def test_a_figure_that_no_drawn_group_counts_is_no_number_and_others_stay() -> None:
    sums, counts = np.array([[1.0, 0.0], [3.0, 0.0]]), np.array([[1.0, 0.0], [1.0, 0.0]])
    one, none = bootstrap_means(sums, counts).T
    assert Figure.of(2.0, one) == Figure(2.0, 1.0, 3.0)
    assert Figure.of(2.0, none) == Figure(2.0)
