"""Small stores whose actions follow from what a test says, and a plain ridge regression."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from sklearn.linear_model import Ridge

from pipeline.evaluate.probe.inputs import LIMIT, STILL
from pipeline.evaluate.probe.ridge import ProbeFolds, ProbeScore
from pipeline.store import FeatureStore
from pipeline.store.chunks import write_seal


@pytest.fixture(scope="session")
def _written(tiny_store: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_store(tmp_path_factory.mktemp("probing"))


@pytest.fixture
def store(_written: Path) -> FeatureStore:
    """Six episodes of 30 ticks, three slots of eight; what is written into it stays in memory."""
    return FeatureStore.open(_written)


def renamed(path: Path, slots: list[dict[str, Any]], **spec: Any) -> FeatureStore:
    """The store of this path with its slots named so, its spec changed so."""
    attrs = zarr.open_group(path, mode="r+").attrs
    attrs["slots"] = slots
    attrs["feature_spec"] = {**dict(attrs["feature_spec"]), **spec}
    write_seal(path)
    return FeatureStore.open(path)


def limited(x: np.ndarray, fold: np.ndarray) -> np.ndarray:
    """Inputs as they are read, each column by the formula itself; `fold` is (repeat, row)."""
    inputs = np.zeros(x.shape)
    for column in range(x.shape[1]):
        values = x[:, column]
        trained = [values[deal != held] for deal in fold for held in np.unique(deal)]
        if min(rows.std() for rows in trained) <= STILL * values.std():
            continue
        lower = max(rows.mean() - LIMIT * rows.std() for rows in trained)
        upper = min(rows.mean() + LIMIT * rows.std() for rows in trained)
        if upper > lower:
            kept = np.clip(values, lower, upper)
            inputs[:, column] = (kept - kept.mean()) / kept.std()
    return inputs


def predicted(x: np.ndarray, y: np.ndarray, other: np.ndarray, ridge: np.ndarray) -> np.ndarray:
    """By scikit-learn's Ridge, which has one penalty for all columns, so they are scaled."""
    scale = 1 / np.sqrt(ridge)
    return Ridge(alpha=len(x)).fit(x * scale, y).predict(other * scale)


def nested(
    x: np.ndarray,
    y: np.ndarray,
    fold: np.ndarray,
    penalties: tuple[float, ...],
    known: int = 0,
    of_known: tuple[float, ...] = (),
) -> tuple[np.ndarray, np.ndarray]:
    """(fold, target) R^2 and the chosen penalties of one deal, on the rows themselves.

    `known` is the number of last columns that have the penalties `of_known` (fold,) instead.
    """
    held_out = np.unique(fold)
    r2 = np.empty((len(penalties), len(held_out), y.shape[1]))
    for at, penalty in enumerate(penalties):
        for held in held_out:
            train = fold != held
            ridge = np.full(x.shape[1], penalty)
            ridge[x.shape[1] - known :] = of_known[held] if known else 0
            error = (y[~train] - predicted(x[train], y[train], x[~train], ridge)) ** 2
            with np.errstate(divide="ignore", invalid="ignore"):
                r2[at, held] = 1 - error.mean(0) / y.var(0)
    chosen = []
    for held in held_out:
        ticks = np.array([(fold == other).sum() * (other != held) for other in held_out])
        chosen.append(int(((r2[:, :, y.std(0) > 0].sum(2)) * ticks).sum(1).argmax()))
    return r2[chosen, held_out], np.array(penalties)[chosen]


def r2_by_fold(score: ProbeScore, folds: ProbeFolds, repeat: int = 0) -> np.ndarray:
    """(fold, target) R^2 of one deal."""
    held = folds.deals[repeat] == np.arange(folds.count)[:, None]
    return 1 - held @ score.losses[repeat] / (held @ score.rows)[:, None]
