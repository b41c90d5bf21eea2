"""The normalisation, fitted on what training may see and nothing else."""

from functools import partial
from typing import Any, NoReturn

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.bfloat16 import widen
from pipeline.base.errors import NumericsError
from pipeline.base.finite import first_non_finite
from pipeline.policy.normalization import Block, ChannelStatistics, Normalization, fit_channels
from pipeline.store import FeatureStore, place
from pipeline.train.batches import Ticks

CHUNK_BYTES = 64 * 2**20
Rows = range | NDArray[np.int64]
"""Rows of one of the store's arrays."""


_ARRAYS = {"tick": "tick/action", "vl": "vl/features"} | {
    stream: f"{stream}/values" for stream in ("sensor", "state")
}


def fit_normalization(
    store: FeatureStore, ticks: Ticks, threads: int | None = None
) -> Normalization:
    """Statistics per channel over the training `ticks` and what was known at them.

    Features over the VL rows that these ticks use, each once, and over all its variants alike, so
    (slot, dim) of one variant; sensor and state over the readings from each episode's start to the
    last of its ticks; a stream that none of them has, has none. Reads the store once, in chunks of
    about 64 MB, a few at a time on `threads` threads (as many as torch has, where None), with a bar
    on a terminal; the same bits for any number of them. Raises `NumericsError` on NaN or inf,
    naming episode, tick or reading, time and channel.
    """
    threads = torch.get_num_threads() if threads is None else threads
    parts: dict[str, list[Rows]] = {
        "tick": _cut(store, "tick", ticks),
        "vl": _cut(store, "vl", np.unique(store.array("tick/vl_row")[ticks])),
        "sensor": _readings(store, ticks, "sensor"),
        "state": _readings(store, ticks, "state"),
    }
    total = sum(len(rows) for several in parts.values() for rows in several)
    with tqdm(total=total, desc="normalisation", unit="row", leave=False, disable=None) as bar:
        fitted = {
            stream: _fit(store, stream, several, bar, threads)
            for stream, several in parts.items()
            if several or stream == "tick"
        }
    return Normalization(fitted.pop("tick"), fitted.pop("vl", None), **fitted)


def _fit(
    store: FeatureStore, stream: str, parts: list[Rows], bar: "tqdm[NoReturn]", threads: int
) -> ChannelStatistics:
    what = {"tick": "training actions", "vl": "training features"}.get(
        stream, f"training readings of {stream}"
    )

    def read(rows: Rows) -> Block:
        values, valid = _read(store, stream, rows)
        bar.update(len(rows))
        return values if valid is None else (values, valid)

    try:
        return fit_channels([partial(read, rows) for rows in parts], what, threads=threads)
    except NumericsError:
        # It knows the row of what it was given, which says nothing to who made the recordings.
        for rows in parts:
            _check_finite(store, stream, rows, what)
        raise


def _check_finite(store: FeatureStore, stream: str, rows: Rows, what: str) -> None:
    values, valid = _read(store, stream, rows)
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
    """The values, of features (row of one variant, slot, dim) with which slots are valid."""
    array = store.array(_ARRAYS[stream])
    values = widen(array[rows.start : rows.stop] if isinstance(rows, range) else array[rows])
    if stream != "vl":
        return values, None
    slots = (-1, store.feature_shape[0])
    valid = store.array("vl/slot_valid")[rows].reshape(slots).astype(bool)
    return values.reshape(*slots, values.shape[-1]), valid
