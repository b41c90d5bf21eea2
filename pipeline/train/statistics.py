"""The normalisation, fitted on the training ticks alone; where a value is not finite."""

from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import Any, NoReturn

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.arrays import first_non_finite, widen
from pipeline.base.channels import action_groups, usual_spread
from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import ConfigError, NumericsError
from pipeline.base.provenance import CLOCK_SLACK_S
from pipeline.policy.attention import right_aligned
from pipeline.policy.normalization import Block, ChannelStatistics, Normalization, fit_channels
from pipeline.policy.robot_state import RelativeActions, expand
from pipeline.policy.shape import (
    PolicyShape,
    channel_kinds,
    expanded_names,
    shared_statistics,
    slot_places,
    told_deltas,
)
from pipeline.store import Batch, FeatureStore, place
from pipeline.train.batches import Ticks, Windows, evenly

CHUNK_BYTES = 64 * 2**20
ONE_WAY = 0.9
"""A channel advances one way where the mean of its net motions in the episodes is at least this
share of their root mean square."""
_STATE_TICKS = 16_384
"""The most training ticks whose windows give the statistics of the states."""
_AT_ONCE = 1024
Rows = range | NDArray[np.int64]
"""Rows of one of the store's arrays."""


_ARRAYS = {"tick": "tick/action", "vl": "vl/features"} | {
    stream: f"{stream}/values" for stream in ("sensor", "state")
}
_NAMES = {"tick": "training actions", "vl": "training features"} | {
    stream: f"training readings of {stream}" for stream in ("sensor", "state")
}
"""What errors call the rows of each array."""


def fit_normalization(
    store: FeatureStore, ticks: Ticks, windows: Windows, threads: int | None = None
) -> Normalization:
    """Statistics per channel over the training `ticks` and the readings before them.

    Features: over the VL rows that these ticks use, each once, with all variants together, so
    (slot, dim), or fewer where slots share them (`shared_statistics`). Sensor: over the readings
    from each episode's start to its last tick. States: as a policy takes them
    (`state_channels.expand`), over the windows of at most 16,384 evenly spaced
    ticks. A stream that no tick has gets no statistics. A spread far below what is usual for
    similar inputs is raised (`ChannelStatistics.floored`). Reads the store once, in chunks of about
    64 MB, a few at a time on `threads` threads (None: as many as torch has), with a bar on a
    terminal. The bits do not depend on the number of threads. Raises `NumericsError` on NaN or inf,
    naming episode, tick or reading, time and channel.
    """
    threads = torch.get_num_threads() if threads is None else threads
    parts: dict[str, list[Rows]] = {
        "tick": _cut(store, "tick", ticks),
        "vl": _cut(store, "vl", np.unique(store.array("tick/vl_row")[ticks])),
        "sensor": _readings(store, ticks, "sensor"),
    }
    total = sum(len(rows) for pieces in parts.values() for rows in pieces)
    with tqdm(total=total, desc="normalisation", unit="row", leave=False, disable=None) as bar:
        fitted = {
            stream: _fit(store, stream, pieces, bar, threads)
            for stream, pieces in parts.items()
            if pieces or stream == "tick"
        }
    features, sensor = fitted.get("vl"), fitted.get("sensor")
    if features is not None:
        slots = store.attrs["slots"][: store.feature_shape[0]]
        places = slot_places(slots)
        index = shared_statistics(places, len(slots) // max(1, len(places)))
        if len({*index}) < len(index):
            features = features.shared(index)
        usual = np.percentile(features.std, 75, axis=-1, keepdims=True)
        features = features.floored(usual)
    if sensor is not None:
        sensor = _floored(sensor, **_channels(store, "sensor"))
    return Normalization(fitted["tick"], features, sensor, _fit_state(store, ticks, windows))


def anchored_channels(store: FeatureStore, ticks: Ticks, params: TrainHeadParams) -> list[str]:
    """The action channels that `train_head.anchor` names; "auto" chooses by the training `ticks`.

    It chooses translations that the state measures too; with a sensor, it leaves out those that
    advance one way (`ONE_WAY`).
    """
    if params.anchor != "auto":
        return [*params.anchor]
    known = store.feature_shape[0] and _readings(store, ticks, "state")
    if not (params.anchored and known):
        return []
    action = store.streams["action"]
    chosen = told_deltas(action, store.streams["state"])
    groups = action_groups(action["names"], action["units"])
    one_way = np.zeros(len(groups), bool)
    if params.sensor_enabled and _readings(store, ticks, "sensor"):
        _, episode = np.unique(store.episode_of(ticks), return_inverse=True)
        net = np.zeros((episode.max() + 1, len(groups)))
        np.add.at(net, episode, store.array("tick/action")[ticks])
        one_way = np.abs(net.mean(axis=0)) >= ONE_WAY * np.sqrt(np.square(net).mean(axis=0))
    channels = zip(action["names"], groups, one_way, strict=True)
    return [n for n, group, away in channels if n in chosen and group == "translation" and not away]


def fit_relative(
    store: FeatureStore, ticks: Ticks, windows: Windows, shape: PolicyShape
) -> ChannelStatistics | None:
    """Statistics of chunks with channels relative to the state; None where the shape has none.

    They are over all valid steps of at most 16,384 evenly spaced ticks. Raises `ConfigError` where
    a tick of the store has no state.
    """
    if not shape.relative:
        return None
    _refuse_without_state(store, windows.state_window_s)
    relative = RelativeActions(shape.relative, shape.kinds)

    def read(batch: Batch) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        chunk = relative.from_absolute(batch.action, batch)
        return chunk.flatten(0, 1).numpy(), batch.action_valid.flatten().numpy() > 0

    batches = _some_batches(store, ticks, replace(windows, sensor_window=1))
    return fit_channels(map(read, batches), "training actions relative to the state")


def _refuse_without_state(store: FeatureStore, window_s: float | None) -> None:
    """Raise `ConfigError` for a tick without a state in its window, of whichever side."""
    ends = store.array("tick/state_end").astype(np.int64)
    ticks = np.arange(store.ticks)
    lacking = ends <= store.array("episode/state_start")[store.episode_of(ticks)]
    if window_s is not None:
        times = store.array("state/time")[np.maximum(ends - 1, 0)]
        lacking |= store.array("tick/time") - times > window_s + CLOCK_SLACK_S
    if lacking.any():
        first = place(store, "tick", int(lacking.argmax()))
        raise ConfigError(
            "train_head.action_form: relative needs a state at every tick, within "
            f"train_head.state_window_s, found none at {first}. Leave that episode out, or set "
            "recorded."
        )


def _fit_state(store: FeatureStore, ticks: Ticks, windows: Windows) -> ChannelStatistics | None:
    readings = _readings(store, ticks, "state")
    if not readings:
        return None
    channels = _channels(store, "state")
    kinds = channel_kinds(**channels)
    batches = _some_batches(store, ticks, replace(windows, horizon=1, sensor_window=1))

    def read(batch: Batch) -> NDArray[np.float32]:
        real = right_aligned(batch.state_valid, batch.state.shape[1])
        return expand(batch.state, kinds)[real].numpy()

    blocks = (block for batch in batches if len(block := read(batch)))
    if (first := next(blocks, None)) is None:
        return None  # all readings are older than the window
    with _place_named(store, "state", readings):
        fitted = fit_channels(chain([first], blocks), _NAMES["state"])
    names = expanded_names(channels["names"], kinds)
    return _floored(fitted, names, [""] * len(names))


def _some_batches(store: FeatureStore, ticks: Ticks, windows: Windows) -> Iterator[Batch]:
    """What at most `_STATE_TICKS` of these ticks see, evenly spread, a few at a time.

    The features are not filled in: those of so many rows may be larger than memory.
    """
    some, gatherer = evenly(ticks, _STATE_TICKS), store.gatherer
    oldest_s = {"sensor": windows.sensor_window_s, "state": windows.state_window_s}
    for part in np.array_split(some, -(-len(some) // _AT_ONCE)):
        sizes = (len(part), windows.horizon, windows.sensor_window, windows.state_window)
        batch = gatherer.empty_batch(*sizes)
        selection = gatherer.select(batch, part, 0, 0.0, 0.0, None, oldest_s)
        gatherer.copy(replace(selection, rows={"action": selection.rows["action"]}), batch)
        yield batch


def _channels(store: FeatureStore, stream: str) -> dict[str, list[str]]:
    return {name: list(store.streams[stream][name]) for name in ("names", "units")}


def _floored(
    fitted: ChannelStatistics, names: Sequence[str], units: Sequence[str]
) -> ChannelStatistics:
    return fitted.floored(usual_spread(fitted.spread, names, units))


def _fit(
    store: FeatureStore, stream: str, parts: list[Rows], bar: "tqdm[NoReturn]", threads: int
) -> ChannelStatistics:

    def read(rows: Rows) -> Block:
        values, valid = _read(store, stream, rows)
        bar.update(len(rows))
        return values if valid is None else (values, valid)

    readings = [partial(read, rows) for rows in parts]
    with _place_named(store, stream, parts):
        return fit_channels(readings, _NAMES[stream], threads=threads)


@contextmanager
def _place_named(store: FeatureStore, stream: str, parts: Iterable[Rows]) -> Generator[None]:
    """Within it, a `NumericsError` names the place in the recordings, not the row of a block."""
    try:
        yield
    except NumericsError:
        for rows in parts:
            check_finite(store, stream, rows, _NAMES[stream], *_read(store, stream, rows))
        raise


def check_finite(
    store: FeatureStore,
    stream: str,
    rows: Rows,
    what: str,
    values: NDArray[Any],
    valid: NDArray[np.bool_] | None = None,
) -> None:
    """Raise `NumericsError`, naming the place, where a valid value of these rows is not finite.

    `values` has a row for each of `rows`; for `vl`, one for each variant of each row.
    """
    bad = first_non_finite(values, valid)
    if bad is None:
        return
    stored, variant = divmod(bad[0], len(values) // len(rows))
    channel = ", ".join(map(str, bad[1:])) + (f" of variant {variant}" if variant else "")
    if stream != "vl":
        names = store.streams["action" if stream == "tick" else stream]["names"]
        channel = repr(names[bad[1]])
    raise NumericsError(
        f"{what}: expected finite numbers, found {values[bad]} at "
        f"{place(store, stream, int(rows[stored]))}, channel {channel}, in {store.path}. Mend or "
        "leave out the recording and run stages.extract again."
    ) from None


def _readings(store: FeatureStore, ticks: Ticks, stream: str) -> list[Rows]:
    """The readings from each episode's start to the last of its ticks, where it has any."""
    starts = store.array(f"episode/{stream}_start")
    ends = np.array(starts, np.int64)
    read = store.array(f"tick/{stream}_end")[ticks].astype(np.int64)
    np.maximum.at(ends, store.episode_of(ticks), read)
    return [range(starts[index], ends[index]) for index in np.flatnonzero(ends > starts)]


def _cut(store: FeatureStore, stream: str, rows: NDArray[np.int64]) -> list[Rows]:
    array = store.array(_ARRAYS[stream])
    step = max(1, CHUNK_BYTES // max(1, array.dtype.itemsize * int(np.prod(array.shape[1:]))))
    return [rows[start : start + step] for start in range(0, len(rows), step)]


def _read(
    store: FeatureStore, stream: str, rows: Rows
) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
    """The values; for features (row of one variant, slot, dim), also which slots are valid."""
    array = store.array(_ARRAYS[stream])
    values = widen(array[rows.start : rows.stop] if isinstance(rows, range) else array[rows])
    if stream != "vl":
        return values, None
    slots = (-1, store.feature_shape[0])
    valid = store.array("vl/slot_valid")[rows].reshape(slots).astype(bool)
    return values.reshape(*slots, values.shape[-1]), valid
