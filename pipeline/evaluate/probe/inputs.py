"""The inputs of a regression at a tick: features of its row; past actions, state and sensor."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from sklearn.preprocessing import StandardScaler
from sklearn.utils.extmath import randomized_svd
from tqdm import tqdm

from pipeline.base.arrays import widen
from pipeline.store import FeatureStore
from pipeline.train.statistics import check_finite
from pipeline.vlm.slots import Slot, layer_name

Inputs = Float64[np.ndarray, "row _"]
"""The inputs or targets of a regression at each VL row or tick."""
Values = Float[np.ndarray, "row dim"]
Folds = Int64[np.ndarray, "repeat row"]
"""The fold that holds each row or tick out, in each deal."""
PAST_ACTIONS = 2
"""Known actions before the tick, as many as the linear-fit baseline has."""
WIDTH = 1024
"""The most inputs of a slot, or of several slots together."""
STREAM_WIDTH = 64
"""The most inputs of each summary of channels that share a unit."""
LIMIT = 5.0
"""Columns are clipped at so many standard deviations from the mean of any training rows."""
STILL = 0.1
"""A column counts as constant where its spread in some training rows is below this share of its
spread over all rows."""
_ROUNDING = 1e-6


@dataclass(frozen=True)
class SlotName(Slot):
    """The name of a slot, or of a group of slots, whose `view` and `cell` are None."""

    @property
    def group(self) -> "SlotName":
        """The name of the group with its layer, norm and pooling."""
        return SlotName(self.layer, self.norm, self.pooling)

    @property
    def label(self) -> str:
        """The name in a few words."""
        words = f"{layer_name(self.layer, self.norm)}, {self.pooling}"
        words += "" if self.view is None else f", {self.view}"
        return words + ("" if self.cell is None else f" cell {self.cell[0]},{self.cell[1]}")


def read_slots(
    store: FeatureStore,
    rows: Int64[np.ndarray, " row"],
    fold: Folds,
    slots: Sequence[int],
    codec: Callable[[Values], Values] = lambda values: values,
) -> tuple[Inputs, Bool[np.ndarray, " row"]]:
    """These slots of the VL `rows` as inputs side by side, and where at least one is valid.

    `fold` is the fold that holds each row out. The slots share `WIDTH` inputs; a slot with more
    channels is reduced to its main directions. An invalid slot gets its mean, which is 0. `codec`
    changes the valid features (row, dim) of a slot first. Raises `NumericsError` on NaN or inf,
    naming the place.
    """
    inputs: list[Inputs] = [np.empty((len(rows), 0))]
    valid = store.array("vl/slot_valid")[rows][:, list(slots)].astype(bool)
    for slot, there in zip(slots, valid.T, strict=True):
        if not there.any():
            continue
        values = widen(store.array("vl/features")[rows[there], slot])
        check_finite(store, "vl", rows[there], f"slot {slot}", values)
        reduced = reduce(codec(values), fold[:, there], max(1, WIDTH // len(slots)))
        inputs.append(np.zeros((len(rows), reduced.shape[1])))
        inputs[-1][there] = reduced
    return np.concatenate(inputs, axis=1), valid.max(axis=1)


def past_actions(store: FeatureStore, ticks: Int64[np.ndarray, " row"], fold: Folds) -> Inputs:
    """The actions of the `PAST_ACTIONS` ticks before each; the mean before an episode's start.

    With them as inputs, a slot gains nothing from showing the robot's own motion.
    """
    action, start = store.array("tick/action"), store.array("episode/tick_start")
    first = start[store.episode_of(ticks)]
    inputs = np.zeros((len(ticks), PAST_ACTIONS, action.shape[1]))
    for back in range(1, PAST_ACTIONS + 1):
        there = ticks - back >= first
        if there.any():
            inputs[there, back - 1] = limit(
                StandardScaler().fit_transform(action[ticks[there] - back].astype(np.float64)),
                fold[:, there],
            )
    return inputs.reshape(len(ticks), -1)


def summarize(
    store: FeatureStore,
    stream: Literal["sensor", "state"],
    ticks: Int64[np.ndarray, " row"],
    fold: Folds,
    window: int,
) -> Inputs:
    """The last, the mean and the spread of every channel over the window before each tick.

    There is no column if the store lacks the stream. More than `STREAM_WIDTH` channels of one unit,
    such as an A-scan's, are reduced to that many main directions of each summary, so that a force
    beside them is not lost. No reading is later than its tick. A tick without a reading gets the
    mean of the others, and a last column marks it. `fold` is the fold that holds each tick out.
    Raises `NumericsError` on NaN or inf, naming the place.
    """
    inputs: list[Inputs] = [np.empty((len(ticks), 0))]
    units: list[str] = store.streams[stream]["units"]
    if not units:
        return inputs[0]
    summaries, known = _summaries(store, stream, ticks, window)
    if not known.any():
        return inputs[0]
    channels_of = {unit: [i for i, u in enumerate(units) if u == unit] for unit in units}
    for summary in summaries:
        for channels in channels_of.values():
            reduced = reduce(summary[known][:, channels], fold[:, known], STREAM_WIDTH)
            inputs.append(np.zeros((len(ticks), reduced.shape[1])))
            inputs[-1][known] = reduced
    inputs.append(known[:, None].astype(np.float64))
    return np.concatenate(inputs, axis=1)


def _summaries(
    store: FeatureStore, stream: str, ticks: Int64[np.ndarray, " tick"], window: int
) -> tuple[Float[np.ndarray, "3 tick channel"], Bool[np.ndarray, " tick"]]:
    """The last reading, the mean and the spread, and whether there was a reading."""
    values = store.array(f"{stream}/values")
    stops = store.array(f"tick/{stream}_end")[ticks]
    first = store.array(f"episode/{stream}_start")[store.episode_of(ticks)]
    starts = np.maximum(first, stops - window)
    summaries = np.zeros((3, len(ticks), values.shape[1]), np.float32)
    pairs = enumerate(zip(starts.tolist(), stops.tolist(), strict=True))
    for tick, (start, stop) in tqdm(pairs, stream, len(ticks), leave=False, disable=None):
        if start == stop:
            continue
        readings = values[start:stop]
        check_finite(store, stream, range(start, stop), stream, readings)
        summaries[:, tick] = (
            readings[-1],
            readings.mean(axis=0, dtype=np.float64),
            readings.std(axis=0, dtype=np.float64),
        )
    return summaries, stops > starts


def reduce(values: Float[np.ndarray, "row channel"], fold: Folds, width: int) -> Inputs:
    """Standardised channels, or at most `width` main directions of them, clipped by `limit`."""
    columns = StandardScaler().fit_transform(values.astype(np.float64))
    width = min(width, len(columns))
    if width < columns.shape[1]:
        options: Any = {"n_iter": 2, "random_state": 0}
        _, _, directions = randomized_svd(columns, width, **options)
        columns = columns @ directions.T
    return limit(columns, fold)


def limit(columns: Inputs, fold: Folds) -> Inputs:
    """Columns of mean 0 and spread 1 over all folds, clipped to what every fold is trained on.

    If a joint moves in one recording only, its spread in the training rows is about 0 when that
    recording is held out. In units of this spread its value there would be thousands, and so would
    the prediction. So a column z, of mean m_f and spread s_f over the rows of all folds but f,
    becomes

        min(max(z, max_f(m_f - LIMIT s_f)), min_f(m_f + LIMIT s_f))

    and 0 where some s_f < `STILL` s or the limits cross: other recordings teach nothing about it.
    f runs over the folds of all deals, so that the same inputs serve all of them. This reads inputs
    of all folds, but no action.
    """
    held = fold[:, None] == np.arange(fold.max() + 1)[:, None]
    trained = 1.0 - held.reshape(-1, len(columns))
    # A slot in one fold only has no training rows while that fold is held out.
    trained = trained[trained.any(axis=1)] if trained.any() else np.ones((1, len(columns)))
    trained /= trained.sum(axis=1, keepdims=True)
    mean = trained @ columns
    spread = np.sqrt(np.maximum(trained @ columns**2 - mean**2, 0))
    lower = (mean - LIMIT * spread).max(axis=0)
    upper = (mean + LIMIT * spread).min(axis=0)
    kept = np.clip(columns, lower, np.maximum(lower, upper))
    within = kept.std(axis=0)
    varies = (spread > STILL * columns.std(axis=0)).all(axis=0)
    varies &= (upper > lower) & (within > _ROUNDING)
    return np.where(varies, (kept - kept.mean(axis=0)) / np.where(varies, within, 1), 0.0)
