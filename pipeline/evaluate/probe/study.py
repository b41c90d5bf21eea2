"""Every slot and group of slots, scored by a linear regression from it to the action chunk."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import TypeAdapter
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from pipeline.base.arrays import widen
from pipeline.base.config import PCA, FeatureDtype, ProbeParams, stored_as
from pipeline.base.errors import ConfigError, NumericsError, StoreMismatch
from pipeline.base.packing import pack, unpack
from pipeline.base.projection import SAMPLE_ROWS, SLOTS_A_ROW, apply_map, fit_map
from pipeline.evaluate.figures import Figure
from pipeline.evaluate.probe.inputs import (
    Inputs,
    SlotName,
    Values,
    past_actions,
    read_slots,
    summarize,
)
from pipeline.evaluate.probe.ridge import ProbeFolds, ProbeScore, cross_validate, fold_by_recording
from pipeline.policy.normalization import fit_channels
from pipeline.store import FEATURES, FeatureStore
from pipeline.store.proofs import stored_name
from pipeline.train.batches import evenly
from pipeline.train.statistics import check_finite

_MOST_SINGLE = 300
"""Most slots that are scored one by one."""
_ROUNDING_SHARE = 1e-5
"""A spread below this share of a channel's size is rounding: the channel does not vary."""
_ROUNDING = 1e-9
"""A gain below this counts as none."""


@dataclass(frozen=True, eq=False)
class ProbeResult:
    """How well a slot or a group of slots predicts; where it is invalid, its mean is used."""

    name: SlotName
    slots: tuple[int, ...]
    channels: int
    """Number of channels of all its slots together."""
    inputs: int
    """Number of inputs of the regression."""
    valid_share: float
    """Share of the ticks at which one of its slots is valid."""
    alone: ProbeScore
    beside: ProbeScore
    """The score with all inputs that are known without features; results are ranked by it."""
    row_bytes: int = 0
    """Bytes of its slots in a row of the store."""


@dataclass(frozen=True, eq=False)
class Known:
    """The inputs known without features, up to one of their blocks, and how well they predict."""

    name: str
    inputs: int
    score: ProbeScore


@dataclass(frozen=True, eq=False)
class CodecResult:
    """What a value of `extract.dtype` would lose of a group of slots."""

    of: ProbeResult
    """The group as it is stored."""
    codec: str
    row_bytes: int
    error: float
    """Root mean square, over channels and rows, of the change of a number, in standard deviations
    of its channel."""
    alone: ProbeScore

    @property
    def difference(self) -> Figure:
        """R^2 alone with this codec minus that of what is stored."""
        return self.alone.gain(self.of.alone)


@dataclass(frozen=True, eq=False)
class ProbeStudy:
    """All results, and the baselines beside them."""

    horizon: int
    folds: ProbeFolds
    mean_action: ProbeScore
    known: tuple[Known, ...]
    """Past actions; then with state; then with sensor too, as far as the store has them."""
    slots: tuple[ProbeResult, ...]
    """In the store's order; of many hundred slots only those that are a group of their own."""
    groups: tuple[ProbeResult, ...]
    codecs: tuple[CodecResult, ...] = ()
    seconds: Mapping[int, float] = field(default_factory=dict)
    """Depth (`depth`) -> s of a pass of one row that stops there; empty where not measured."""

    @property
    def baseline(self) -> Known:
        """All inputs that are known without features."""
        return self.known[-1]

    def gain(self, result: ProbeResult) -> Figure:
        """The R^2 that a result adds to the baseline."""
        return result.beside.gain(self.baseline.score)


@dataclass(frozen=True, eq=False)
class Recommendation:
    """The choice of layer, norm and pooling that the evidence supports."""

    reading: Literal["beside", "alone"]
    """The scores it rests on: `beside` if a choice adds to what is known, else `alone`."""
    best: ProbeResult
    """The group with the highest score of those that gain."""
    chosen: ProbeResult
    """Of `best` and those tied with it, the one with the fewest slots, then the lowest layer, which
    costs the least."""
    tied: tuple[ProbeResult, ...]
    """The other groups that gain and are tied with `best`."""


def probe(store: FeatureStore, params: ProbeParams) -> ProbeStudy:
    """Ridge regression from every slot of variant 0 to the action chunk, cross-validated.

    Each slot and each choice of layer, norm and pooling is scored alone, and beside the inputs that
    are known without features: the actions of the ticks before, and the last, mean and spread of
    the causal windows of state and sensor. Each of these blocks has its own penalty; they are
    chosen one after the other. Folds hold whole recordings and are dealt `params.repeats` times.
    Each of `params.threads` threads has one slot or group in memory, which grows with
    `params.max_ticks`. The same store and params give the same bits for any number of threads. A
    bar shows the progress on a terminal.

    Raises `StoreMismatch` where fewer than two recordings are long enough, and `NumericsError` on
    NaN or inf, naming the place.
    """
    stored = stored_name(store.spec)
    if params.codecs and stored != "float32":
        raise StoreMismatch(
            f"probe.codecs: expected a store in float32, from which other types are judged, found "
            f"{stored} in {store.path}. Extract it with extract.dtype float32, some recordings do"
        )
    slots, dim = store.feature_shape
    if any(isinstance(codec, PCA) and codec.pca > dim for codec in params.codecs):
        raise ConfigError(
            f"probe.codecs: the features of {store.path} have only {dim} numbers. Set pca to at "
            f"most {dim}."
        )
    action = store.array("tick/action")
    check_finite(store, "tick", range(store.ticks), "actions", action)
    folds = fold_by_recording(store, params.folds, params.horizon, params.max_ticks, params.repeats)
    names = TypeAdapter(list[SlotName]).validate_python(store.attrs["slots"][:slots])
    singles = {(index,): name for index, name in enumerate(names)}
    groups = {
        tuple(index for index, name in enumerate(names) if name.group == group): group
        for group in dict.fromkeys(name.group for name in names)
    }
    rows, first, of_tick = np.unique(
        store.array("tick/vl_row")[folds.ticks], return_index=True, return_inverse=True
    )
    fold, targets = folds.fold, _targets(action, folds, params.horizon)

    penalties_of: list[tuple[Inputs, NDArray[np.float64]]] = []
    known: list[Known] = []

    def score(inputs: Inputs, beside: bool = False) -> ProbeScore:
        return cross_validate(
            inputs, targets, folds, params.penalties, penalties_of if beside else ()
        )

    def coded(group: ProbeResult, codec: FeatureDtype) -> CodecResult:
        squares: list[float] = []
        rank = codec.pca if isinstance(codec, PCA) else dim
        basis = _Projection(store, rows, group.slots, rank) if isinstance(codec, PCA) else None

        def change(values: Values) -> Values:
            numbers = values if basis is None else apply_map(values, basis.affine)
            changed = unpack(pack(torch.from_numpy(numbers), stored_as(codec))).float().numpy()
            if not np.isfinite(changed).all():
                raise NumericsError(
                    f"probe.codecs {codec}: {group.name.label} has numbers up to "
                    f"{np.abs(values).max():.3g}, which {codec} cannot hold. Leave it out."
                )
            spread = values.std(axis=0, dtype=np.float64)
            varies = spread > _ROUNDING_SHARE * np.abs(values).max(axis=0)
            if varies.any():
                again = changed if basis is None else basis.expand(changed)
                errors = (again - values)[:, varies] / spread[varies]
                squares.append(float(np.mean(errors**2)))
            return changed

        inputs, _ = read_slots(store, rows, fold[:, first], group.slots, change)
        row_bytes = pack(torch.zeros(len(group.slots), rank), stored_as(codec)).nbytes
        error = float(np.sqrt(np.mean(squares or [0.0])))
        return CodecResult(group, str(codec), row_bytes, error, score(inputs[of_tick]))

    def result(own: tuple[int, ...]) -> ProbeResult:
        inputs, valid = read_slots(store, rows, fold[:, first], own)
        inputs = inputs[of_tick]
        return ProbeResult(
            name=tasks[own],
            slots=own,
            channels=len(own) * dim,
            inputs=inputs.shape[1],
            valid_share=float(valid[of_tick].mean()),
            alone=score(inputs),
            beside=score(inputs, beside=True),
            row_bytes=store.array("vl/features")[:1, list(own)].nbytes,
        )

    # Each slot and its linear algebra stay on one thread: the same bits for any number of threads.
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(params.threads) as pool:
        mean_action = score(np.empty((len(folds.ticks), 0)))
        for name, block in _known_blocks(store, folds.ticks, fold, params):
            before = known[-1] if known else Known("", 0, mean_action)
            named = f"{before.name} + {name}" if known else name
            known.append(Known(named, before.inputs + block.shape[1], score(block, beside=True)))
            penalties_of.append((block, known[-1].score.penalties))
        # A group of one slot is that slot. Of hundreds of slots, each alone would take hours.
        tasks = groups | (singles if len(singles) <= _MOST_SINGLE else {})
        bar = tqdm(pool.map(result, tasks), "probing", len(tasks), leave=False, disable=None)
        results = {result.slots: result for result in bar}
        pairs = [(results[own], codec) for own in groups for codec in params.codecs]
        judged = pool.map(lambda pair: coded(*pair), pairs)
        codecs = tuple(tqdm(judged, "codecs", len(pairs), leave=False, disable=None))
    return ProbeStudy(
        horizon=params.horizon,
        folds=folds,
        mean_action=mean_action,
        known=tuple(known),
        slots=tuple(results[own] for own in singles if own in results),
        groups=tuple(results[own] for own in groups),
        codecs=codecs,
    )


class _Projection:
    """The projection of a group's features that extraction would fit, and the way back."""

    def __init__(
        self, store: FeatureStore, rows: NDArray[np.int64], slots: Sequence[int], rank: int
    ) -> None:
        """Fitted on as many valid slots of these VL rows as an extraction takes, evenly spread."""
        valid = store.array("vl/slot_valid")[rows][:, list(slots)] != 0
        row, slot = np.nonzero(valid)
        chosen = evenly(np.arange(len(row)), SAMPLE_ROWS * min(len(slots), SLOTS_A_ROW))
        values = widen(store.array(FEATURES)[rows[row[chosen]], np.array(slots)[slot[chosen]]])
        self.affine, _ = fit_map(values, rank)
        self._mean, self._spread = values.mean(axis=0), values.std(axis=0, dtype=np.float64)
        self._back = np.linalg.pinv(self.affine[:-1] * self._spread[:, None])

    def expand(self, numbers: Values) -> Values:
        """The features whose coefficients these are, in standardised channels the nearest."""
        return self._mean + (numbers @ self._back) * self._spread


def _known_blocks(
    store: FeatureStore, ticks: NDArray[np.int64], fold: NDArray[np.int64], params: ProbeParams
) -> list[tuple[str, Inputs]]:
    """Past actions, state and sensor at the ticks, as far as the store has them."""
    blocks = [
        ("past actions", past_actions(store, ticks, fold)),
        ("state", summarize(store, "state", ticks, fold, params.state_window)),
        ("sensor", summarize(store, "sensor", ticks, fold, params.sensor_window)),
    ]
    return [(name, block) for name, block in blocks if block.shape[1]]


def _targets(action: NDArray[np.float32], folds: ProbeFolds, horizon: int) -> Inputs:
    """The action chunk (step x channel) at each tick, standardised over the whole store."""
    statistics = fit_channels([action], "actions")
    chunks = action[folds.ticks[:, None] + np.arange(horizon)].astype(np.float64)
    return ((chunks - statistics.mean) / statistics.scale).reshape(len(chunks), -1)


def depth(name: SlotName) -> int:
    """The layers that must run for a slot; the vision tower comes before the first."""
    return -1 if name.layer == "vision" else name.layer


def ranked(results: Sequence[ProbeResult]) -> list[ProbeResult]:
    """The results, the best first."""
    return sorted(results, key=lambda result: result.beside.mean, reverse=True)


def recommend(study: ProbeStudy) -> Recommendation | None:
    """The recommendation among the groups that gain; None where no group does.

    A group gains where the interval of its R^2 is above 0, and where it is better than the inputs
    known without features and than the mean action. "Better" means that the interval of the
    difference is above 0. A group is tied with the best if the best is not better and the group has
    at least half of its gain: with few recordings, wide intervals alone would tie anything.
    """
    readings: tuple[Literal["beside", "alone"], ...] = ("beside", "alone")
    for reading in readings:
        floor = [study.mean_action, *([study.baseline.score] if reading == "beside" else [])]
        scores: dict[ProbeResult, ProbeScore] = {
            group: score
            for group in study.groups
            if ((score := getattr(group, reading)).r2.low or 0) > 0
            and all(_is_better(score, other) for other in floor)
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
            key=lambda group: (len(group.slots), depth(group.name), -scores[group].mean),
        )
        return Recommendation(reading, best, chosen, tied)
    return None


def _is_better(score: ProbeScore, other: ProbeScore) -> bool:
    """Whether the interval of the difference is above 0."""
    gain = score.gain(other)
    return gain.value > _ROUNDING and bool(gain.resolved)
