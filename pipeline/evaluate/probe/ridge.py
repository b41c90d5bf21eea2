"""Ridge regression from sums alone: nothing here knows how many rows there were.

The coefficients that minimise |y - Xb|^2 + penalty * n * |b|^2 over n rows of standardised X solve
(X'X / n + penalty * I) b = X'y / n (Hoerl & Kennard 1970, eq. 2.1; Hastie, Tibshirani & Friedman,
The Elements of Statistical Learning, eq. 3.44), and the squared error on other rows follows from
their X'X, X'y and y'y alike. So one pass that keeps these of each part of the folds gives every
fold, every penalty and the choice among them exactly. One Cholesky factor a penalty serves the
inputs alone and beside what is known (by its Schur complement); six of them cost less than an
eigendecomposition, which would serve all penalties (at 2048 columns 6 x 0.07 s against 1.3 s).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.base.errors import NumericsError
from pipeline.evaluate.probe.moments import Moments, total, variance
from pipeline.evaluate.probe.projection import STILL


@dataclass(frozen=True, eq=False)
class Score:
    """How much of the action chunk a reader predicts on recordings that it was not fitted on."""

    r2: NDArray[np.float64]
    """(fold, target): 1 - mean squared error in the fold / variance over all rows; NaN where a
    target does not vary or a fold has no row."""
    rows: NDArray[np.float64]
    """(fold,) ticks that were predicted."""
    penalties: tuple[float, ...]
    """(fold,) of the inputs, chosen on the parts that were trained on; NaN for a fold without a
    row."""

    @property
    def by_target(self) -> NDArray[np.float64]:
        """(target,) over all held-out rows: 1 - PRESS / total sum of squares (Allen 1974)."""
        there = self.rows > 0
        return self.rows[there] @ self.r2[there] / self.rows.sum()

    @property
    def by_fold(self) -> NDArray[np.float64]:
        """(fold,) over the targets that vary, NaN for a fold without a row."""
        return _mean(self.r2)

    @property
    def mean(self) -> float:
        """Over all held-out rows and the targets that vary."""
        return float(_mean(self.by_target))

    @property
    def error(self) -> float:
        """The standard error of `mean`, from the spread over the folds."""
        return standard_error(self.by_fold)


def standard_error(by_fold: NDArray[np.float64]) -> float:
    """Of the mean of what differs by fold; folds that are NaN do not count."""
    there = by_fold[np.isfinite(by_fold)]
    return float(there.std(ddof=1) / np.sqrt(len(there)))


@dataclass(frozen=True, eq=False)
class Scores:
    """Of the same inputs, by themselves and beside what is known anyway."""

    alone: Score
    beside: Score | None
    """None where nothing is known beside them."""


def cross_validate(
    parts: Sequence[Moments],
    fold_of_part: Sequence[int],
    targets: int,
    penalties: Sequence[float],
    known: int = 0,
    known_score: Score | None = None,
) -> Scores | None:
    """The scores of ridge regression from the columns before the last `known + targets`.

    Each fold is predicted from the others, with the penalty that predicts best when of those one
    part at a time is left out in turn, over all targets in units of their spread there (but those
    that hardly vary there, by `STILL`, which would outweigh the others). Beside the inputs the
    `known` columns stand with the penalty that `known_score`, from them alone, chose for the same
    fold: one penalty for both would make a few good inputs pay for many idle ones (a penalty an
    input is Hoerl & Kennard's general form, 1970, section 5). Inputs have about spread 1 over all
    folds; one below `STILL` of it in what is trained on is not used. None where the rows lie in too
    few folds. Raises `NumericsError` for a penalty that is too small for float64.
    """
    held = {
        fold: [i for i, one in enumerate(fold_of_part) if one == fold and parts[i].rows > 0]
        for fold in range(max(fold_of_part) + 1)
    }
    everything = [i for several in held.values() for i in several]
    trained = {
        fold: [i for i in everything if i not in several]
        for fold, several in held.items()
        if several
    }
    if len(trained) < 2 or any(len(several) < 2 for several in trained.values()):
        return None
    readings = [dict.fromkeys(trained, _LEFT_OUT)]
    if known_score is not None:
        readings.append({fold: known_score.penalties[fold] for fold in trained})
    folded = _Folded(parts, held, trained, tuple(penalties), known, targets)
    alone, *beside = folded.scores(readings)
    return Scores(alone, beside[0] if beside else None)


_LEFT_OUT = float("inf")
"""The penalty of columns that are not used."""


@dataclass(frozen=True, eq=False)
class _Folded:
    """Everything that the nested choice of a penalty needs."""

    parts: Sequence[Moments]
    held: Mapping[int, Sequence[int]]
    trained: Mapping[int, Sequence[int]]
    penalties: tuple[float, ...]
    known: int
    targets: int

    def scores(self, readings: Sequence[Mapping[int, float]]) -> list[Score]:
        """One for each of `readings`, fold -> penalty of what is known."""
        spread = self._variance([part for part in self.parts if part.rows > 0])
        inner = self._left_out(readings)
        r2 = np.full((len(readings), len(self.held), self.targets), np.nan)
        rows = np.zeros(len(self.held))
        best = np.full((len(readings), len(self.held)), np.nan)
        for fold, several in self.trained.items():
            fit = self._fit(several)
            within = self._variance([self.parts[i] for i in several])
            varies = (within > 0) & (within > STILL**2 * spread)
            test = total([self.parts[i] for i in self.held[fold]])
            rows[fold] = test.rows
            for index, reading in enumerate(readings):
                of_known = reading[fold]
                lost = torch.stack([inner[frozenset(several) - {i}, of_known, i] for i in several])
                at = int((lost.sum(dim=0)[:, varies] / within[varies]).sum(dim=1).argmin())
                best[index, fold] = self.penalties[at]
                weights = fit.weights(self.penalties[at], [of_known])
                error = fit.squared_errors(test, weights)[0] / test.rows
                r2[index, fold] = torch.where(spread > 0, 1 - error / spread, torch.nan).numpy()
        return [
            Score(one, rows, tuple(chosen.tolist())) for one, chosen in zip(r2, best, strict=True)
        ]

    def _left_out(
        self, readings: Sequence[Mapping[int, float]]
    ) -> dict[tuple[frozenset[int], float, int], Tensor]:
        """(penalty, target) squared errors by what was trained on, penalty of what is known, part.

        Folds of one part each share: what is left without two of them chooses for both.
        """
        wanted: dict[frozenset[int], dict[int, set[float]]] = {}
        for fold, several in self.trained.items():
            for one in several:
                tests = wanted.setdefault(frozenset(several) - {one}, {})
                tests.setdefault(one, set()).update(reading[fold] for reading in readings)
        found = {}
        for train, tests in wanted.items():
            fit = self._fit(sorted(train))
            each = sorted(set.union(*tests.values()))
            weights = [one for penalty in self.penalties for one in fit.weights(penalty, each)]
            for test in sorted(tests):
                errors = fit.squared_errors(self.parts[test], weights)
                by_known = errors.view(len(self.penalties), len(each), self.targets)
                found |= {(train, one, test): by_known[:, index] for index, one in enumerate(each)}
        return found

    def _fit(self, several: Sequence[int]) -> "_Fit":
        return _Fit(total([self.parts[i] for i in several]), self.known, self.targets)

    def _variance(self, several: Sequence[Moments]) -> Tensor:
        return variance(total([part.last(self.targets) for part in several]), self.targets)


class _Fit:
    """Ridge regressions on the same rows, which share what they can."""

    def __init__(self, train: Moments, known: int, targets: int) -> None:
        self._targets = targets
        self._inputs = len(train.sum) - known - targets
        self._mean = train.sum / train.rows
        gram = (train.gram / train.rows).addr_(self._mean, self._mean, alpha=-1)
        spread = gram.diagonal().clamp(min=0).sqrt()
        # Inputs spread by 1 over all folds. What hardly varies here says nothing of what it does
        # elsewhere, and in units of so little a row elsewhere would outweigh all others.
        self._scale = torch.where(spread > STILL, 1 / spread, 0.0)
        self._scale[-targets:] = 1
        self._gram = gram.mul_(self._scale).mul_(self._scale[:, None])

    def weights(self, penalty: float, of_known: Sequence[float]) -> list[Tensor]:
        """(column, target) of what the targets are read from, for each penalty of the known.

        All have the factor of the inputs, the costly one; the known are eliminated after it.
        """
        inputs, targets = self._inputs, self._targets
        crossed = self._gram[:inputs, inputs:]
        solved = _solved(self._gram[:inputs, :inputs], crossed, penalty)
        of_inputs, alone = solved[:, :-targets], solved[:, -targets:]
        # The Schur complement of the inputs, with the known and the targets.
        rest = self._gram[inputs:, inputs:] - crossed.T @ solved
        found = []
        for ridge in of_known:
            known = torch.zeros((len(rest) - targets, targets), dtype=torch.float64)
            if ridge != _LEFT_OUT:
                known = _solved(rest[:-targets, :-targets], rest[:-targets, -targets:], ridge)
            both = torch.cat([alone - of_inputs @ known, known])
            found.append(both * self._scale[:-targets, None])
        return found

    def squared_errors(self, test: Moments, weights: Sequence[Tensor]) -> Tensor:
        """(weights, target) sums over the rows of `test`."""
        targets = self._targets
        width = len(test.sum) - targets
        each = torch.stack(list(weights))
        side_by_side = each.permute(1, 0, 2).reshape(width, len(each) * targets)
        fitted = (test.gram[:width, :width] @ side_by_side).view(width, len(each), targets)
        square = (each * (fitted.permute(1, 0, 2) - 2 * test.gram[:width, width:])).sum(dim=1)
        square += test.gram.diagonal()[width:]
        constant = self._mean[width:] - self._mean[:width] @ each
        left = test.sum[width:] - test.sum[:width] @ each
        return square - 2 * constant * left + test.rows * constant.square()


def _solved(inputs: Tensor, product: Tensor, penalty: float) -> Tensor:
    width = len(inputs)
    # Rows of 2048 and the like fall on the same few cache lines: twice as slow as a few more.
    size = width + 8 if width % 256 == 0 else width
    ridged = torch.eye(size, dtype=torch.float64)
    ridged[:width, :width] = inputs
    ridged.diagonal()[:width].add_(penalty)
    factor, failed = torch.linalg.cholesky_ex(ridged)
    if failed:
        raise NumericsError(
            f"probe.penalties: {penalty:g} is too small for {width} "
            "inputs that depend on each other. Leave it out; 0.001 and more serve every store."
        )
    right = torch.zeros((size, product.shape[1]), dtype=torch.float64)
    right[:width] = product
    return torch.cholesky_solve(right, factor)[:width]


def _mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Over the last axis, of what is finite; NaN where nothing is."""
    there = np.isfinite(values)
    total = np.where(there, values, 0.0).sum(axis=-1)
    return np.where(there.any(axis=-1), total / np.maximum(there.sum(axis=-1), 1), np.nan)
