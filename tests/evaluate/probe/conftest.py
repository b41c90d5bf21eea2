"""Small stores whose actions follow from what a test says, and a plain ridge regression."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr

from pipeline.evaluate.probe.projection import LIMIT, STILL
from pipeline.store import FeatureStore

Rewrite = Callable[[FeatureStore, np.random.Generator], None]


@pytest.fixture(scope="session")
def _written(tiny_store: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_store(tmp_path_factory.mktemp("probing"))


@pytest.fixture
def store(_written: Path) -> FeatureStore:
    """Six episodes of 30 ticks, three slots of eight; what is written into it stays in memory."""
    return FeatureStore.open(_written)


@pytest.fixture
def renamed() -> Callable[..., FeatureStore]:
    """`renamed(path, slots, **spec)`: the store with its slots named so, its spec changed so."""

    def rename(path: Path, slots: list[dict[str, Any]], **spec: Any) -> FeatureStore:
        attrs = zarr.open_group(path, mode="r+").attrs
        attrs["slots"] = slots
        attrs["feature_spec"] = {**dict(attrs["feature_spec"]), **spec}
        return FeatureStore.open(path)

    return rename


def fitted(
    x: np.ndarray, y: np.ndarray, penalty: float | np.ndarray
) -> Callable[[np.ndarray], np.ndarray]:
    """Ridge regression written down as in the textbook, on the rows themselves.

    An input that hardly varies here is not used: `x` spreads by about 1 over all folds.
    """
    mean, spread = x.mean(0), x.std(0)
    spread[spread <= STILL] = np.inf
    standard = (x - mean) / spread
    ridge = np.diag(np.broadcast_to(penalty, x.shape[1])) * len(x)
    weights = np.linalg.solve(standard.T @ standard + ridge, standard.T @ (y - y.mean(0)))
    return lambda other: (other - mean) / spread @ weights + y.mean(0)


@pytest.fixture
def limited() -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """`limited(x, fold)`: inputs as a reader gives them, each column by the formula itself."""

    def limit(x: np.ndarray, fold: np.ndarray) -> np.ndarray:
        found = np.zeros(x.shape)
        for column in range(x.shape[1]):
            values = x[:, column]
            trained = [values[fold != held] for held in np.unique(fold)]
            if min(one.std() for one in trained) <= STILL * values.std():
                continue
            lower = max(one.mean() - LIMIT * one.std() for one in trained)
            upper = min(one.mean() + LIMIT * one.std() for one in trained)
            if upper > lower:
                kept = np.clip(values, lower, upper)
                found[:, column] = (kept - kept.mean()) / kept.std()
        return found

    return limit


@pytest.fixture
def nested() -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """`nested(x, y, fold, penalties)`: (fold, target) R^2 and the chosen penalties, row by row.

    `known` is the number of last columns that have the penalties `of_known` (fold,) instead.
    """

    def score(
        x: np.ndarray,
        y: np.ndarray,
        fold: np.ndarray,
        penalties: tuple[float, ...],
        known: int = 0,
        of_known: tuple[float, ...] = (),
    ) -> tuple[np.ndarray, np.ndarray]:
        r2, chosen = [], []
        for held in np.unique(fold):
            train = fold != held
            lost = np.zeros(len(penalties))
            ridges = [np.full(x.shape[1], penalty) for penalty in penalties]
            for ridge in ridges:
                ridge[x.shape[1] - known :] = of_known[held] if known else 0
            for out in np.unique(fold[train]):
                inside, test = train & (fold != out), fold == out
                for index, ridge in enumerate(ridges):
                    error = (y[test] - fitted(x[inside], y[inside], ridge)(x[test])) ** 2
                    varies = y[train].std(0) > STILL * y.std(0)
                    lost[index] += (error[:, varies] / y[train][:, varies].var(0)).sum()
            best = int(lost.argmin())
            predicted = fitted(x[train], y[train], ridges[best])(x[~train])
            with np.errstate(divide="ignore", invalid="ignore"):
                r2.append(1 - ((y[~train] - predicted) ** 2).mean(0) / y.var(0))
            chosen.append(penalties[best])
        return np.array(r2), np.array(chosen)

    return score
