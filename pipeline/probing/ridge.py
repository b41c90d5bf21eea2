"""Ridge regression from sums alone: nothing here knows how many rows there were.

The coefficients that minimise |y - Xb|^2 + penalty * n * |b|^2 over n rows of standardised X solve
(X'X / n + penalty * I) b = X'y / n (Hoerl & Kennard 1970, eq. 2.1; Hastie, Tibshirani & Friedman,
The Elements of Statistical Learning, eq. 3.44), and the squared error on other rows follows from
their X'X, X'y and y'y alike. So one pass that keeps these of each part of the folds gives every
fold, every penalty and the choice among them exactly. Cholesky factors, one a penalty, cost less
than an eigendecomposition that serves all of them until there are about ten (at 2048 columns
0.14 s against 1.2 s).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.errors import NumericsError
from pipeline.probing.moments import VARIES, Moments, centred, total, variance


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


def cross_validate(
    parts: Sequence[Moments],
    fold_of_part: Sequence[int],
    inputs: Tensor,
    targets: int,
    penalties: Sequence[float],
    known: Tensor | None = None,
    known_score: Score | None = None,
) -> Score | None:
    """The score of ridge regression from the `inputs` among the columns, of which the last
    `targets` are the targets.

    Each fold is predicted from the others, with the penalty that predicts best when of those one
    part at a time is left out in turn, over all targets in units of their spread there. Columns
    `known` stand beside the inputs with the penalty that `known_score`, from them alone, chose for
    the same fold: one penalty for both would make a few good inputs pay for many idle ones (a
    penalty an input is Hoerl & Kennard's general form, 1970, section 5). None where the rows lie in
    too few folds. Raises `NumericsError` for a penalty that is too small for float64.
    """
    none = torch.empty(0, dtype=torch.int64)
    beside = none if known is None else known
    columns = torch.cat([inputs, beside, torch.arange(-targets, 0) + len(parts[0].sum)])
    chosen = [part.of(columns) for part in parts]
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
    ridges = {}
    for fold in trained:
        of_known = 0.0 if known_score is None else known_score.penalties[fold]
        ridges[fold] = tuple((penalty, of_known) for penalty in penalties)
    return _Folded(chosen, held, trained, ridges, (len(inputs), len(beside)), targets).score()


Ridges = tuple[tuple[float, float], ...]
"""Candidates: the penalty of the inputs, and of what is known beside them."""


@dataclass(frozen=True, eq=False)
class _Folded:
    """Everything that the nested choice of a penalty needs."""

    parts: Sequence[Moments]
    held: Mapping[int, Sequence[int]]
    trained: Mapping[int, Sequence[int]]
    ridges: Mapping[int, Ridges]
    widths: tuple[int, int]
    targets: int

    def score(self) -> Score:
        everything = [part for part in self.parts if part.rows > 0]
        spread = variance(total(everything), self.targets)
        inner = self._left_out()
        r2 = np.full((len(self.held), self.targets), np.nan)
        rows = np.zeros(len(self.held))
        best = [float("nan")] * len(self.held)
        for fold, several in self.trained.items():
            ridges, train = self.ridges[fold], total([self.parts[i] for i in several])
            test = total([self.parts[i] for i in self.held[fold]])
            lost = torch.stack([inner[frozenset(several) - {i}, ridges, i] for i in several])
            within = variance(train, self.targets)
            varies = within > 0
            at = int((lost.sum(dim=0)[:, varies] / within[varies]).sum(dim=1).argmin())
            best[fold] = ridges[at][0]
            error = self._errors(train, [test], (ridges[at],))[0][0] / test.rows
            r2[fold] = torch.where(spread > 0, 1 - error / spread, torch.nan).numpy()
            rows[fold] = test.rows
        return Score(r2, rows, tuple(best))

    def _left_out(self) -> dict[tuple[frozenset[int], Ridges, int], Tensor]:
        """(penalty, target) squared errors on each part by what was trained on.

        Folds of one part each share: what is left without two of them chooses for both.
        """
        wanted: dict[tuple[frozenset[int], Ridges], set[int]] = {}
        for fold, several in self.trained.items():
            for one in several:
                train = frozenset(several) - {one}
                wanted.setdefault((train, self.ridges[fold]), set()).add(one)
        found = {}
        for (train, ridges), tests in wanted.items():
            ordered = sorted(tests)
            rows = total([self.parts[i] for i in sorted(train)])
            errors = self._errors(rows, [self.parts[i] for i in ordered], ridges)
            found |= {
                (train, ridges, one): error for one, error in zip(ordered, errors, strict=True)
            }
        return found

    def _errors(self, train: Moments, tests: Sequence[Moments], ridges: Ridges) -> list[Tensor]:
        widths = torch.tensor(self.widths)
        each = torch.tensor(ridges, dtype=torch.float64).repeat_interleave(widths, dim=1)
        return squared_errors(train, tests, self.targets, each)


def squared_errors(
    train: Moments, tests: Sequence[Moments], targets: int, penalties: Tensor
) -> list[Tensor]:
    """(candidate, target) sums of squared errors on each of `tests`, fitted on `train`.

    `penalties` (candidate, input). Without inputs, the mean of the targets is what is predicted.
    """
    width = len(train.sum) - targets
    mean = train.sum / train.rows
    gram = centred(train, mean) / train.rows
    spread = gram.diagonal().clamp(min=0).sqrt()[:width]
    # What does not vary says nothing: 0 after standardisation.
    scale = torch.where(spread > VARIES, 1 / spread, 0.0)
    inputs = gram[:width, :width] * scale * scale[:, None]
    product = gram[:width, width:] * scale[:, None]
    weights = torch.stack(
        [_solved(inputs, product, penalty) * scale[:, None] for penalty in penalties]
    )
    side_by_side = weights.permute(1, 0, 2).reshape(width, len(penalties) * targets)
    found = []
    for test in tests:
        other = centred(test, mean)
        fitted = (other[:width, :width] @ side_by_side).view(width, len(penalties), targets)
        crossed = 2 * other[:width, width:] - fitted.permute(1, 0, 2)
        explained = (weights * crossed).sum(dim=1)
        found.append(other.diagonal()[width:] - explained)
    return found


def _solved(inputs: Tensor, product: Tensor, penalty: Tensor) -> Tensor:
    ridged = inputs.clone()
    ridged.diagonal().add_(penalty)
    factor, failed = torch.linalg.cholesky_ex(ridged)
    if failed:
        raise NumericsError(
            f"probe.penalties: {float(penalty.min()):g} is too small for {len(inputs)} "
            "inputs that depend on each other. Leave it out; 0.001 and more serve every store."
        )
    return torch.cholesky_solve(product, factor)


def _mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Over the last axis, of what is finite; NaN where nothing is."""
    there = np.isfinite(values)
    total = np.where(there, values, 0.0).sum(axis=-1)
    return np.where(there.any(axis=-1), total / np.maximum(there.sum(axis=-1), 1), np.nan)
