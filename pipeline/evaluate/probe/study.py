"""Every slot and every group of slots, scored by what a linear reader finds in it, and ranked."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import TypeAdapter
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from pipeline.base.config import ProbeParams
from pipeline.base.errors import NumericsError
from pipeline.base.finite import first_non_finite
from pipeline.evaluate.probe.folds import ProbeFolds, fold_by_recording
from pipeline.evaluate.probe.inputs import Inputs, SlotName, read_slots, summarize
from pipeline.evaluate.probe.ridge import ProbeScore, cross_validate, standard_error
from pipeline.policy.normalization import fit_channels
from pipeline.store import FeatureStore, place

_ROUNDING = 1e-9
"""A gain below this is none."""


@dataclass(frozen=True, eq=False)
class ProbeResult:
    """How well a slot or a group of slots predicts; where it is not valid, its mean stands."""

    name: SlotName
    slots: tuple[int, ...]
    channels: int
    """Of all its slots together."""
    inputs: int
    """That the regression had of them."""
    valid_share: float
    """Of the ticks, those at which one of its slots is valid."""
    alone: ProbeScore
    beside: ProbeScore | None
    """With state + sensor; None where the store has neither."""

    @property
    def best(self) -> ProbeScore:
        """What it is ranked by: beside state + sensor, where there are any."""
        return self.beside or self.alone


@dataclass(frozen=True, eq=False)
class ProbeStudy:
    """All results, and what they are measured against."""

    horizon: int
    action_names: tuple[str, ...]
    folds: ProbeFolds
    mean_action: ProbeScore
    streams: ProbeScore | None
    """State + sensor alone; None where the store has neither."""
    stream_inputs: int
    slots: tuple[ProbeResult, ...]
    """In the store's order."""
    groups: tuple[ProbeResult, ...]

    def gain(self, result: ProbeResult) -> tuple[float, float] | tuple[None, None]:
        """What a result adds to state + sensor, and the standard error of that by fold."""
        if self.streams is None or result.beside is None:
            return None, None
        apart = result.beside.by_fold - self.streams.by_fold
        return result.beside.mean - self.streams.mean, standard_error(apart)


@dataclass(frozen=True, eq=False)
class Recommendation:
    """The choice of layer, norm and pooling that the evidence supports."""

    reading: Literal["beside", "alone"]
    """What it rests on: `beside` state + sensor where a choice gains so, else `alone`."""
    best: ProbeResult
    """With the highest score of those that gain."""
    chosen: ProbeResult
    """Of `best` and those tied with it, the one with the fewest slots, then the lowest layer: it
    costs the least to extract, to keep and to read."""
    tied: tuple[ProbeResult, ...]
    """The others that gain, not to be told from `best`."""


def probe(store: FeatureStore, params: ProbeParams) -> ProbeStudy:
    """Ridge regression from every slot of variant 0 to the action chunk, cross-validated.

    Alone, and beside the last, mean and spread of the causal windows of state and sensor; each slot
    by itself and each choice of layer, norm and pooling as a whole. Folds hold whole recordings, so
    nothing that tells a recording from another helps. Each of `params.threads` threads has one slot
    or one group in memory, which grows with `params.max_ticks`. The same store and params give the
    same bits, whatever the threads. A bar shows the progress on a terminal.

    Raises `StoreMismatch` where fewer than two recordings are long enough, and `NumericsError` on
    NaN or inf, naming the place.
    """
    folds = fold_by_recording(store, params.folds, params.horizon, params.max_ticks)
    slots, dim = store.feature_shape
    names = TypeAdapter(list[SlotName]).validate_python(store.attrs["slots"][:slots])
    singles = {(index,): name for index, name in enumerate(names)}
    groups = {
        tuple(index for index, name in enumerate(names) if name.group == group): group
        for group in dict.fromkeys(name.group for name in names)
    }
    rows, first, of_tick = np.unique(
        store.array("tick/vl_row")[folds.ticks], return_index=True, return_inverse=True
    )
    targets = _targets(store, folds, params.horizon)

    def score(inputs: Inputs, known: Inputs | None = None, of_known: Sequence[float] = ()):
        return cross_validate(inputs, targets, folds.fold, params.penalties, known, of_known)

    def result(own: tuple[int, ...]) -> ProbeResult:
        inputs, valid = read_slots(store, rows, folds.fold[first], own)
        inputs = inputs[of_tick]
        return ProbeResult(
            name=tasks[own],
            slots=own,
            channels=len(own) * dim,
            inputs=inputs.shape[1],
            valid_share=float(valid[of_tick].mean()),
            alone=score(inputs),
            beside=None if streams is None else score(inputs, known, streams.penalties),
        )

    # A slot a thread, and linear algebra on that thread: the same bits, whatever the threads.
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(params.threads) as pool:
        known = summarize(store, folds.ticks, folds.fold, params.sensor_window, params.state_window)
        mean_action = score(known[:, :0])
        streams = score(known) if known.shape[1] else None
        tasks = groups | singles  # a group of one slot is that slot
        bar = tqdm(pool.map(result, tasks), "probing", len(tasks), leave=False, disable=None)
        results = {result.slots: result for result in bar}
    return ProbeStudy(
        horizon=params.horizon,
        action_names=tuple(store.streams["action"]["names"]),
        folds=folds,
        mean_action=mean_action,
        streams=streams,
        stream_inputs=known.shape[1],
        slots=tuple(results[own] for own in singles),
        groups=tuple(results[own] for own in groups),
    )


def _targets(store: FeatureStore, folds: ProbeFolds, horizon: int) -> Inputs:
    """The action chunk (step x channel) at each tick, standardised over the whole store."""
    action = store.array("tick/action")
    if bad := first_non_finite(action):
        name = store.streams["action"]["names"][bad[1]]
        raise NumericsError(
            f"actions: expected finite numbers, found {action[bad]} at "
            f"{place(store, 'tick', bad[0])}, channel {name!r}. Mend the recording and run "
            "stages.extract again."
        )
    statistics = fit_channels([action], "actions")
    chunks = action[folds.ticks[:, None] + np.arange(horizon)].astype(np.float64)
    return ((chunks - statistics.mean) / statistics.scale).reshape(len(chunks), -1)


def ranked(results: Sequence[ProbeResult]) -> list[ProbeResult]:
    """The best first."""
    return sorted(results, key=lambda result: result.best.mean, reverse=True)


def recommend(study: ProbeStudy) -> Recommendation | None:
    """Among the groups that gain; None where none does.

    A group gains where it is better than what is known without features and than the mean action.
    One is better than another where the mean over folds of their difference is above its standard
    error (the one-standard-error rule of The Elements of Statistical Learning, section 7.10, on
    differences by fold, as all face the same recordings), and their median above 0, so that it does
    not rest on one strange fold. Two that gain are tied where the first is not better and the
    second keeps half of its gain: a wide spread of few folds would tie anything.
    """
    for reading in ("beside", "alone"):
        floor = [study.mean_action]
        if reading == "beside" and study.streams is not None:
            floor.append(study.streams)
        read = ((group, getattr(group, reading)) for group in study.groups)
        scores: dict[ProbeResult, ProbeScore] = {
            group: score
            for group, score in read
            if score is not None and all(_is_better(score, other) for other in floor)
        }
        if not scores:
            continue
        best, *others = sorted(scores, key=lambda group: scores[group].mean, reverse=True)
        known = max(other.mean for other in floor)
        half = (scores[best].mean + known) / 2
        tied = tuple(
            group
            for group in others
            if not _is_better(scores[best], scores[group]) and scores[group].mean >= half
        )
        chosen = min(
            [best, *tied],
            key=lambda group: (len(group.slots), group.name.layer, -scores[group].mean),
        )
        return Recommendation(reading, best, chosen, tied)
    return None


def _is_better(score: ProbeScore, other: ProbeScore) -> bool:
    """Fold by fold, as `recommend` says."""
    apart = score.by_fold - other.by_fold
    ahead = score.mean - other.mean > max(standard_error(apart), _ROUNDING)
    return bool(ahead and np.median(apart) > 0)
