"""Ridge regression, cross-validated by parts of folds, its penalty chosen on what is trained on.

The coefficients that minimise |y - Xb|^2 + penalty * n * |b|^2 over n rows solve
(X'X + penalty * n * I) b = X'y (Hoerl & Kennard 1970, eq. 2.1), as `sklearn.linear_model.Ridge`
does; the intercept has no penalty. A penalty an input, the general form (section 5 there), and a
choice among penalties inside each fold are some 190 regressions a slot, all on the same few parts:
X'X of each part is taken once and serves all, where `Ridge` takes it again each time (0.68 s
against 0.06 s a regression, 12,000 rows of 745 inputs on one thread).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from pipeline.base.errors import NumericsError
from pipeline.evaluate.probe.inputs import STILL, Inputs

Gram = Float64[np.ndarray, "column column"]
"""Z'Z of rows Z = (1, inputs, what is known beside them, targets)."""
Errors = Float64[np.ndarray, " target"]
_VARIES = 1e-6
"""A standard deviation below this share of the whole data's is rounding, not signal."""


@dataclass(frozen=True, eq=False)
class ProbeScore:
    """How much of the action chunk inputs predict on recordings that they were not fitted on."""

    r2: NDArray[np.float64]
    """(fold, target): 1 - mean squared error in the fold / variance over all rows; NaN where a
    target does not vary."""
    rows: NDArray[np.float64]
    """(fold,) ticks that were predicted."""
    penalties: tuple[float, ...]
    """(fold,) of the inputs, chosen on the parts that were trained on."""

    @property
    def by_target(self) -> NDArray[np.float64]:
        """(target,) over all held-out rows: 1 - PRESS / total sum of squares (Allen 1974)."""
        return self.rows @ self.r2 / self.rows.sum()

    @property
    def by_fold(self) -> NDArray[np.float64]:
        """(fold,) over the targets that vary."""
        return np.nanmean(self.r2, axis=1)

    @property
    def mean(self) -> float:
        """Over all held-out rows and the targets that vary."""
        return float(np.nanmean(self.by_target))

    @property
    def error(self) -> float:
        """The standard error of `mean`, from the spread over the folds."""
        return standard_error(self.by_fold)


def standard_error(by_fold: NDArray[np.float64]) -> float:
    """Of the mean of what differs by fold."""
    return float(by_fold.std(ddof=1) / np.sqrt(len(by_fold)))


def cross_validate(
    inputs: Inputs,
    targets: Inputs,
    part: Int64[np.ndarray, " row"],
    fold: Int64[np.ndarray, " row"],
    penalties: Sequence[float],
    known: Inputs | None = None,
    of_known: Sequence[float] = (),
) -> ProbeScore:
    """The score of ridge regression from `inputs`, which spread by about 1 over all rows.

    Each fold is predicted from the others, with the penalty that predicts best when of those one
    part at a time is left out in turn, over all targets in units of their spread there (but those
    that hardly vary there, by `STILL`, which would outweigh the others). Beside the inputs stands
    what is `known`, with the penalty `of_known` of each fold: one penalty for both would make a few
    good inputs pay for many idle ones. Raises `NumericsError` for a penalty that is too small for
    float64.
    """
    parts = np.unique(part)
    rows = [np.ones((len(targets), 1)), inputs, *([] if known is None else [known]), targets]
    grams: dict[int, Gram] = {}
    for p in parts:
        here = np.concatenate([columns[part == p] for columns in rows], axis=1)
        grams[p] = here.T @ here
    width = len(grams[parts[0]]) - targets.shape[1]

    @cache
    def total(several: frozenset[int]) -> Gram:
        return np.sum([grams[p] for p in sorted(several)], axis=0)

    @cache  # folds of one part each leave out the same two
    def errors(train: frozenset[int], test: frozenset[int], penalty: float, of: float) -> Errors:
        ridge = np.full(width, of)
        ridge[: 1 + inputs.shape[1]] = penalty
        return _errors(total(test), _weights(total(train), ridge))

    overall = _variance(total(frozenset(parts)), width)
    scores, best, ticks = [], [], []
    for held in range(fold.max() + 1):
        test = frozenset(part[fold == held])
        train = frozenset(parts) - test
        of = 0.0 if known is None else of_known[held]
        within = _variance(total(train), width)
        varies = (within > 0) & (within > STILL**2 * overall)
        losses: list[float] = []
        for penalty in penalties:
            left_out = [errors(train - {p}, frozenset({p}), penalty, of) for p in sorted(train)]
            lost = np.sum(left_out, axis=0)
            losses.append((lost[varies] / within[varies]).sum())
        best.append(penalties[int(np.argmin(losses))])
        ticks.append(total(test)[0, 0])
        error = errors(train, test, best[-1], of) / ticks[-1]
        scores.append(1 - error / np.where(overall > 0, overall, np.nan))
    return ProbeScore(np.array(scores), np.array(ticks), tuple(best))


def _weights(gram: Gram, ridge: Float64[np.ndarray, " input"]) -> Float64[np.ndarray, "input t"]:
    """Of ridge regression with a penalty for each input but the first, the intercept."""
    width = len(ridge)
    penalty = ridge * gram[0, 0]
    penalty[0] = 0
    try:
        factor = cho_factor(gram[:width, :width] + np.diag(penalty), overwrite_a=True)
    except LinAlgError:
        raise NumericsError(
            f"probe.penalties: {ridge.min():g} is too small for {width - 1} "
            "inputs that depend on each other. Leave it out; 0.001 and more serve every store."
        ) from None
    return cho_solve(factor, gram[:width, width:])


def _errors(gram: Gram, weights: Float64[np.ndarray, "input target"]) -> Errors:
    """Squared errors of the weights, summed over the rows: Xw - y is (X, y) times (w, -1)."""
    residual = np.concatenate([weights, -np.eye(weights.shape[1])])
    return (residual * (gram @ residual)).sum(axis=0)


def _variance(gram: Gram, width: int) -> Errors:
    """Of each target, 0 where it does not vary."""
    variance = gram.diagonal()[width:] / gram[0, 0] - (gram[0, width:] / gram[0, 0]) ** 2
    return np.where(variance > _VARIES**2, variance, 0.0)
