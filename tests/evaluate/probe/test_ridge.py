"""Scores are those of scikit-learn's ridge regression on the rows."""

from collections.abc import Callable

import numpy as np
import pytest

from pipeline.base.errors import NumericsError
from pipeline.evaluate.probe.ridge import cross_validate

PENALTIES = (1e-3, 1e-1, 1.0, 30.0)
Rows = tuple[np.ndarray, np.ndarray, np.ndarray]
Nested = Callable[..., tuple[np.ndarray, np.ndarray]]


@pytest.fixture
def rows() -> Rows:
    """Inputs (one of which never varies), targets (one of which never varies), and folds."""
    rng = np.random.default_rng(0)
    x = rng.normal(0.3, 1, (200, 7))
    x[:, 5] = x[:, 0] + 1e-3 * rng.normal(size=200)
    x[:, 6] = 0.0
    y = x[:, :3] @ rng.normal(size=(3, 4)) + rng.normal(size=(200, 4)) * [0.1, 1, 3, 0.5]
    y[:, 3] = 0.0
    return x, y, np.sort(rng.integers(0, 4, 200))


def test_scores_and_penalties_are_those_of_rows(rows: Rows, nested: Nested) -> None:
    x, y, fold = rows
    score = cross_validate(x, y, fold, PENALTIES)
    r2, chosen = nested(x, y, fold, PENALTIES)
    np.testing.assert_allclose(score.r2[:, :3], r2[:, :3], atol=1e-8)
    assert np.isnan(score.r2[:, 3]).all()
    np.testing.assert_array_equal(score.penalties, chosen)
    assert score.rows.tolist() == np.bincount(fold).tolist()
    pooled = (r2[:, :3] * np.bincount(fold)[:, None]).sum(0) / len(fold)
    assert score.mean == pytest.approx(pooled.mean(), abs=1e-8)
    by_fold = r2[:, :3].mean(1)
    assert score.error == pytest.approx(by_fold.std(ddof=1) / 2, abs=1e-8)


def test_what_is_known_keeps_its_own_penalties(rows: Rows, nested: Nested) -> None:
    x, y, fold = rows
    of_known = (1e-2, 1.0, 1.0, 30.0)
    score = cross_validate(x[:, [1, 2]], y, fold, PENALTIES, x[:, [0, 3]], of_known)
    r2, chosen = nested(x[:, [1, 2, 0, 3]], y, fold, PENALTIES, 2, of_known)
    np.testing.assert_allclose(score.r2[:, :3], r2[:, :3], atol=1e-8)
    np.testing.assert_array_equal(score.penalties, chosen)


def test_no_inputs_are_the_mean_of_the_others(rows: Rows) -> None:
    _, y, fold = rows
    score = cross_validate(np.empty((200, 0)), y, fold, PENALTIES)
    for held in range(4):
        mean = y[fold != held].mean(0)
        expected = 1 - ((y[fold == held] - mean) ** 2).mean(0)[:3] / y.var(0)[:3]
        np.testing.assert_allclose(score.r2[held, :3], expected, atol=1e-10)
    assert score.mean < 0


def test_each_of_two_folds_chooses_the_penalty_of_the_other(rows: Rows, nested: Nested) -> None:
    x, y, fold = rows
    score = cross_validate(x, y, fold // 2, PENALTIES)
    r2, chosen = nested(x, y, fold // 2, PENALTIES)
    np.testing.assert_allclose(score.r2[:, :3], r2[:, :3], atol=1e-8)
    np.testing.assert_array_equal(score.penalties, chosen)


def test_a_penalty_below_rounding_is_refused(rows: Rows) -> None:
    x, y, fold = rows
    with pytest.raises(NumericsError, match="1e-300 is too small"):
        cross_validate(np.hstack([x, x]), y, fold, (1e-300,))
