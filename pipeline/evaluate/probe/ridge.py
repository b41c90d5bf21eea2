"""Ridge regression, cross-validated by folds of recordings; see `cross_validate`.

The coefficients that minimise |y - Xb|^2 + penalty * n * |b|^2 over n rows solve
(X'X + penalty * n * I) b = X'y (Hoerl & Kennard 1970, eq. 2.1); the intercept has no penalty, and
each block of inputs has its own (section 5 there). `sklearn.linear_model.Ridge` computes X'X anew
at every fit, and `RidgeCV` holds out rows, not recordings. Here X'X of the rows that always share a
fold serves all deals, folds and penalties, and the known blocks are regressed out of the inputs
once for all penalties (Frisch & Waugh 1933).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, reduce

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from sklearn.model_selection import GroupKFold

from pipeline.base.errors import NumericsError, StoreMismatch
from pipeline.evaluate.figures import Figure, bootstrap_means
from pipeline.evaluate.probe.inputs import Inputs
from pipeline.store import FeatureStore
from pipeline.train.batches import evenly
from pipeline.train.split import episodes_by_group

Gram = Float64[np.ndarray, "_ _"]
"""Z'Z of rows Z = (1, what is known beside the inputs, inputs, targets)."""
_VARIES = 1e-6
"""A standard deviation below this share of the whole data's is rounding, not signal."""
_PARTS = 4
"""The most parts of a fold; parts are dealt as units. This bounds time and memory."""


@dataclass(frozen=True, eq=False)
class ProbeFolds:
    """The ticks that are read, ascending, and the folds that hold them out, dealt several times."""

    ticks: NDArray[np.int64]
    """(tick,) store-global; the whole action chunk of each lies within its episode."""
    group: NDArray[np.int64]
    """(tick,) the recording of each, counted from 0."""
    deals: NDArray[np.int64]
    """(repeat, group): the fold that holds a recording out in each deal."""
    notes: tuple[str, ...]
    """What a reader of the scores must know about the folds."""

    @property
    def count(self) -> int:
        """Number of folds."""
        return int(self.deals.max()) + 1

    @property
    def recordings(self) -> int:
        """Number of groups."""
        return self.deals.shape[1]

    @property
    def fold(self) -> NDArray[np.int64]:
        """(repeat, tick): the fold that holds a tick out in each deal."""
        return self.deals[:, self.group]


def fold_by_recording(
    store: FeatureStore, folds: int, horizon: int, max_ticks: int | None = None, repeats: int = 1
) -> ProbeFolds:
    """Deal whole recordings `repeats` times to at most `folds` folds of about equally many ticks.

    Episodes that are one recording in several formats share a fold. Ticks whose chunk of `horizon`
    actions reaches beyond the episode's end are left out, so that all steps of the chunk are scored
    on the same ticks; at most `max_ticks` of the others are read, evenly spread. With no more
    recordings than folds, each is held out alone, in a single deal. Raises `StoreMismatch` where
    fewer than two recordings have such ticks.
    """
    recording = np.full(store.ticks, -1, np.int64)
    for index, episodes in enumerate(episodes_by_group(store).values()):
        for episode in episodes:
            stop = max(episode.ticks.start, episode.ticks.stop - horizon + 1)
            recording[episode.ticks.start : stop] = index
    ticks = np.flatnonzero(recording >= 0)
    most = len(ticks) if max_ticks is None else max_ticks
    read = evenly(ticks, most)
    distinct, group = np.unique(recording[read], return_inverse=True)
    recordings = len(distinct)
    if recordings < 2:
        raise StoreMismatch(
            f"{store.path}: expected at least two recordings of {horizon} ticks or more, of which "
            f"each is predicted from the others, found {recordings}. Add recordings to "
            "data.sources and run stages.extract, or set a shorter probe.horizon or more "
            "probe.max_ticks."
        )
    count = min(folds, recordings)
    notes = _notes(store, recordings, folds, horizon)
    if most < len(ticks):
        notes.append(f"{most} of the ticks are read, evenly spread (probe.max_ticks)")
    deals = _deal(group, count, 1 if recordings == count else repeats)
    return ProbeFolds(read, group, deals, tuple(notes))


def _deal(group: NDArray[np.int64], folds: int, repeats: int) -> NDArray[np.int64]:
    """(repeat, group) the fold of each group: parts of about equal size, dealt by a fixed seed."""
    part = np.empty(group.max() + 1, np.int64)
    parts = min(_PARTS * folds, len(part))
    for index, (_, held) in enumerate(GroupKFold(parts).split(group, groups=group)):
        part[group[held]] = index
    rng = np.random.default_rng(0)
    return np.array([rng.permutation(np.arange(parts) % folds)[part] for _ in range(repeats)])


def _notes(store: FeatureStore, recordings: int, folds: int, horizon: int) -> list[str]:
    """Notes on left-out ticks, and on fewer recordings and folds than expected."""
    notes = []
    if horizon > 1:
        notes.append(f"the last {horizon - 1} ticks of each episode lack a whole chunk: left out")
    if recordings < len(store.episodes):
        notes.append(
            f"{len(store.episodes)} episodes make {recordings} recordings: those of one recording "
            f"in several formats count once, and those shorter than {horizon} ticks not at all"
        )
    if recordings < folds:
        notes.append(f"{recordings} recordings make {recordings} folds, not {folds}")
    return notes


@dataclass(frozen=True, eq=False)
class ProbeScore:
    """How well inputs predict the action chunk on held-out recordings."""

    losses: NDArray[np.float64]
    """(repeat, group, target): squared errors of a held-out recording's ticks, summed, in units of
    the variance over all rows; NaN where a target does not vary."""
    rows: NDArray[np.float64]
    """(group,) ticks that were predicted."""
    penalties: NDArray[np.float64]
    """(repeat, fold): the penalty of the inputs, chosen on the other folds."""

    @property
    def explained(self) -> NDArray[np.float64]:
        """(repeat, group): R^2 times ticks, the mean over the targets that vary."""
        return self.rows - np.nanmean(self.losses, axis=2)

    @cached_property
    def r2(self) -> Figure:
        """R^2 over all held-out rows and the targets that vary."""
        return estimate(self.explained, self.rows)

    @property
    def mean(self) -> float:
        """`r2` without its interval."""
        return self.r2.value

    def gain(self, known: "ProbeScore") -> Figure:
        """This R^2 minus that of `known`, on the same recordings in the same deals."""
        return estimate(self.explained - known.explained, self.rows)


def estimate(explained: NDArray[np.float64], rows: NDArray[np.float64]) -> Figure:
    """R^2 and its interval, from the `explained` (repeat, group) part of each recording's `rows`.

    The value is the mean over the deals of repeated cross-validation (Burman 1989). The interval
    covers the choice of recordings and of folds: its percentiles are over all deals, in each of
    which the same recordings are drawn with replacement (`bootstrap_means`). Regressions are not
    fitted again for each draw.
    """
    draws = bootstrap_means(explained.T, rows[:, None])
    return Figure.of(float(explained.sum(axis=1).mean() / rows.sum()), draws.ravel())


def cross_validate(
    inputs: Inputs,
    targets: Inputs,
    folds: ProbeFolds,
    penalties: Sequence[float],
    known: Sequence[tuple[Inputs, NDArray[np.float64]]] = (),
) -> ProbeScore:
    """The score of ridge regression from `inputs`, whose spread is about 1 over all rows.

    Each fold of each deal is predicted from the other folds. Its penalty is the one that predicts
    those other folds best, each of them from all folds but itself, over all targets in units of
    their spread. The blocks of `known` inputs are used too, each with its own penalties (repeat,
    fold): one penalty for all would make a few good inputs pay for many idle ones. Raises
    `NumericsError` for a penalty that is too small for float64.
    """
    order = np.argsort(folds.group, kind="stable")
    group = folds.group[order]
    blocks = [np.ones((len(targets), 1)), *(block for block, _ in known)]
    widths = [block.shape[1] for block in blocks]
    rows = np.concatenate([*blocks, inputs, targets], axis=1)[order]
    variance = targets.var(axis=0)
    variance = np.where(variance > _VARIES**2, variance, np.nan)
    dealt, part = np.unique(folds.deals, axis=1, return_inverse=True)
    shared = (rows[part[group] == index] for index in range(dealt.shape[1]))
    grams = [here.T @ here for here in shared]
    total = reduce(np.add, grams)
    chosen = np.empty((len(dealt), folds.recordings, targets.shape[1]))
    best = np.empty((len(dealt), folds.count), np.int64)
    for repeat, fold_of_part in enumerate(dealt):
        fold = folds.deals[repeat]
        losses = np.empty((len(penalties), *chosen.shape[1:]))
        for held in range(folds.count):
            train = total - sum(grams[index] for index in np.flatnonzero(fold_of_part == held))
            here = fold[group] == held
            starts = np.flatnonzero(np.diff(group[here], prepend=-1))
            of_known = np.repeat([0.0, *(own[repeat, held] for _, own in known)], widths)
            left, apart = _regress_out(train, of_known, rows[here])
            x, y = np.split(apart, [inputs.shape[1]], axis=1)
            for at, penalty in enumerate(penalties):
                ridge = np.full(inputs.shape[1], penalty * train[0, 0])
                squares = (x @ _solve(left, ridge) - y) ** 2
                losses[at, fold == held] = np.add.reduceat(squares, starts) / variance
        others = fold[:, None] != np.arange(folds.count)
        best[repeat] = np.argmin(np.nansum(losses, axis=2) @ others, axis=0)
        chosen[repeat] = losses[best[repeat][fold], np.arange(len(fold))]
    return ProbeScore(chosen, np.bincount(group).astype(np.float64), np.array(penalties)[best])


def _regress_out(
    gram: Gram, ridge: Float64[np.ndarray, " known"], rows: Inputs
) -> tuple[Gram, Inputs]:
    """The gram matrix and rows of inputs and targets, minus what the known columns explain."""
    width = len(ridge)
    weights = _solve(gram, ridge * gram[0, 0])
    return (
        gram[width:, width:] - gram[width:, :width] @ weights,
        rows[:, width:] - rows[:, :width] @ weights,
    )


def _solve(gram: Gram, ridge: Float64[np.ndarray, " first"]) -> Float64[np.ndarray, "first _"]:
    """Weights of the first columns, with these penalties, to predict each of the others."""
    width = len(ridge)
    system = np.array(gram[:width, :width], order="F")
    system[np.diag_indices(width)] += ridge
    try:
        factor = cho_factor(system, overwrite_a=True, check_finite=False)
    except LinAlgError:
        raise NumericsError(
            f"probe.penalties: one is too small for {width} inputs that depend on each other. "
            "Leave it out; 0.001 and more serve every store."
        ) from None
    return cho_solve(factor, gram[:width, width:], check_finite=False)
