"""Scores from sums are those of a plain ridge regression on the rows."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.base.errors import NumericsError
from pipeline.evaluate.probe.moments import Moments
from pipeline.evaluate.probe.ridge import Score, cross_validate

PENALTIES = (1e-3, 1e-1, 1.0, 30.0)


def moments(rows: np.ndarray) -> Moments:
    each = torch.from_numpy(rows)
    return Moments(len(rows), each.sum(0), each.T @ each)


def scored(parts: list[Moments], folds: Sequence[int], penalties: tuple[float, ...]) -> Score:
    """From all columns but the last four."""
    scores = cross_validate(parts, folds, 4, penalties)
    assert scores is not None
    assert scores.beside is None
    return scores.alone


@pytest.fixture
def rows() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inputs (one of which never varies), targets (one of which never varies), and folds."""
    rng = np.random.default_rng(0)
    x = rng.normal(0.3, 1, (200, 7))
    x[:, 5] = x[:, 0] + 1e-3 * rng.normal(size=200)
    x[:, 6] = 2.0
    y = x[:, :3] @ rng.normal(size=(3, 4)) + rng.normal(size=(200, 4)) * [0.1, 1, 3, 0.5]
    y[:, 3] = 0.0
    return x, y, np.sort(rng.integers(0, 4, 200))


def test_scores_and_penalties_are_those_of_rows(
    rows: tuple[np.ndarray, ...], nested: Callable[..., tuple[np.ndarray, np.ndarray]]
) -> None:
    x, y, fold = rows
    parts = [moments(np.hstack([x, y])[fold == index]) for index in range(4)]
    score = scored(parts, range(4), PENALTIES)
    r2, chosen = nested(x, y, fold, PENALTIES)
    np.testing.assert_allclose(score.r2[:, :3], r2[:, :3], atol=1e-8)
    assert np.isnan(score.r2[:, 3]).all()
    np.testing.assert_array_equal(score.penalties, chosen)
    assert score.rows.tolist() == np.bincount(fold).tolist()
    pooled = (r2[:, :3] * np.bincount(fold)[:, None]).sum(0) / len(fold)
    assert score.mean == pytest.approx(pooled.mean(), abs=1e-8)
    by_fold = r2[:, :3].mean(1)
    assert score.error == pytest.approx(by_fold.std(ddof=1) / 2, abs=1e-8)


def test_what_is_known_keeps_the_penalty_it_chose_alone(
    rows: tuple[np.ndarray, ...], nested: Callable[..., tuple[np.ndarray, np.ndarray]]
) -> None:
    x, y, fold = rows
    both = np.hstack([x[:, [1, 2, 0, 3]], y])
    parts = [moments(both[fold == index]) for index in range(4)]
    without = scored([part.last(2 + 4) for part in parts], range(4), PENALTIES)
    scores = cross_validate(parts, range(4), 4, PENALTIES, 2, without)
    assert scores is not None
    score = scores.beside
    assert score is not None
    _, of_known = nested(x[:, [0, 3]], y, fold, PENALTIES)
    np.testing.assert_array_equal(without.penalties, of_known)
    r2, chosen = nested(x[:, [1, 2, 0, 3]], y, fold, PENALTIES, 2, tuple(of_known))
    np.testing.assert_allclose(score.r2[:, :3], r2[:, :3], atol=1e-8)
    np.testing.assert_array_equal(score.penalties, chosen)
    r2, chosen = nested(x[:, [1, 2]], y, fold, PENALTIES)
    np.testing.assert_allclose(scores.alone.r2[:, :3], r2[:, :3], atol=1e-8)
    np.testing.assert_array_equal(scores.alone.penalties, chosen)


def test_folds_that_share_what_they_train_on_keep_their_own_penalties(
    rows: tuple[np.ndarray, ...], nested: Callable[..., tuple[np.ndarray, np.ndarray]]
) -> None:
    x, y, fold = rows
    parts = [moments(np.hstack([x[:, :5], y])[fold == index]) for index in range(4)]
    of_known = (1e-2, 1.0, 1.0, 30.0)
    alone = scored([part.last(6) for part in parts], range(4), PENALTIES)
    without = replace(alone, penalties=of_known)
    scores = cross_validate(parts, range(4), 4, PENALTIES, 2, without)
    assert scores is not None
    assert scores.beside is not None
    r2, chosen = nested(x[:, :5], y, fold, PENALTIES, 2, of_known)
    np.testing.assert_allclose(scores.beside.r2[:, :3], r2[:, :3], atol=1e-8)
    np.testing.assert_array_equal(scores.beside.penalties, chosen)


def test_a_width_that_is_padded_gives_the_same(
    nested: Callable[..., tuple[np.ndarray, np.ndarray]],
) -> None:
    rng = np.random.default_rng(1)
    x = rng.normal(size=(300, 256))
    y = x[:, :2] + 0.1 * rng.normal(size=(300, 2))
    fold = np.arange(300) % 3
    parts = [moments(np.hstack([x, y])[fold == index]) for index in range(3)]
    scores = cross_validate(parts, range(3), 2, (1e-2, 1.0))
    assert scores is not None
    r2, chosen = nested(x, y, fold, (1e-2, 1.0))
    np.testing.assert_allclose(scores.alone.r2, r2, atol=1e-8)
    np.testing.assert_array_equal(scores.alone.penalties, chosen)


def test_no_inputs_are_the_mean_of_the_others(rows: tuple[np.ndarray, ...]) -> None:
    _, y, fold = rows
    parts = [moments(y[fold == index]) for index in range(4)]
    score = scored(parts, range(4), PENALTIES)
    for held in range(4):
        mean = y[fold != held].mean(0)
        expected = 1 - ((y[fold == held] - mean) ** 2).mean(0)[:3] / y.var(0)[:3]
        np.testing.assert_allclose(score.r2[held, :3], expected, atol=1e-10)
    assert score.mean < 0


def test_folds_of_two_halves_choose_within_the_other(
    rows: tuple[np.ndarray, ...],
) -> None:
    """With two folds, one half of what is trained on chooses the penalty of the other."""
    x, y, part = rows
    parts = [moments(np.hstack([x, y])[part == index]) for index in range(4)]
    score = scored(parts, (0, 0, 1, 1), (1.0,))
    assert score.r2.shape == (2, 4)
    assert score.rows.tolist() == [(part < 2).sum(), (part > 1).sum()]


def test_too_few_folds_with_rows_are_no_score(rows: tuple[np.ndarray, ...]) -> None:
    x, y, _ = rows
    both = np.hstack([x, y])
    none = moments(both[:0])
    there = [moments(both[:50]), moments(both[50:99])]
    assert cross_validate([*there, none], range(3), 4, PENALTIES) is None
    more = [*there, none, moments(both[99:])]
    score = scored(more, range(4), PENALTIES)
    assert np.isnan(score.by_fold).tolist() == [False, False, True, False]
    assert np.isfinite(score.mean)
    assert np.isfinite(score.error)


def test_a_penalty_below_rounding_is_refused(rows: tuple[np.ndarray, ...]) -> None:
    x, y, fold = rows
    both = np.hstack([x, x, y])
    parts = [moments(both[fold == index]) for index in range(4)]
    with pytest.raises(NumericsError, match="1e-300 is too small"):
        cross_validate(parts, range(4), 4, (1e-300,))
