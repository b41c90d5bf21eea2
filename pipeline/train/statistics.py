"""The normalisation, fitted on what training may see and nothing else."""

from functools import partial
from typing import Any, NamedTuple, NoReturn

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.errors import NumericsError
from pipeline.policy.normalization import Block, ChannelStatistics, Normalization, fit_channels
from pipeline.store import FeatureStore, place
from pipeline.train.batches import Ticks

CHUNK_BYTES = 64 * 2**20
THREAD_BYTES = 2**20
"""Of a part on average, below which it costs more to hand it to a thread than to read it."""
Rows = range | NDArray[np.int64]
"""Rows of one of the store's arrays."""


class _Chunk(NamedTuple):
    rows: Rows
    """Where in the store the values lie; of features, each row has one value a variant."""
    values: NDArray[np.floating]
    valid: NDArray[np.bool_] | None
    """(row, slot) of features: False for what is neither checked nor counted."""


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
        "tick": _split(_array(store, "tick"), ticks),
        "vl": _split(_array(store, "vl"), np.unique(store.array("tick/vl_row")[ticks])),
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
        chunk = _chunk(store, stream, rows)
        bar.update(len(rows))
        return chunk.values if chunk.valid is None else (chunk.values, chunk.valid)

    array = _array(store, stream)
    size = sum(map(len, parts)) * array.dtype.itemsize * int(np.prod(array.shape[1:]))
    threads = threads if size >= THREAD_BYTES * len(parts) else 1
    names = None if stream == "vl" else store.streams[_streams_entry(stream)]["names"]
    try:
        return fit_channels([partial(read, rows) for rows in parts], what, names, threads)
    except NumericsError:
        # It knows the row of what it was given, which says nothing to who made the recordings.
        for rows in parts:
            _refuse_not_finite(store, stream, _chunk(store, stream, rows), what)
        raise


def _refuse_not_finite(store: FeatureStore, stream: str, chunk: _Chunk, what: str) -> None:
    counted = True if chunk.valid is None else chunk.valid[..., None]
    bad = np.argwhere(~np.isfinite(chunk.values) & counted)
    if len(bad):
        row, *channel = (int(index) for index in bad[0])
        stored, variant = divmod(row, len(chunk.values) // len(chunk.rows))
        name = ", ".join(map(str, channel))
        if stream != "vl":
            name = repr(store.streams[_streams_entry(stream)]["names"][channel[0]])
        augmented = f" of variant {variant}" if variant else ""
        raise NumericsError(
            f"{what}: expected finite numbers, found {chunk.values[(row, *channel)]} at "
            f"{place(store, stream, int(chunk.rows[stored]))}, channel {name}{augmented}, in "
            f"{store.path}. Mend or leave out the recording and run stages.extract again."
        ) from None


def _streams_entry(stream: str) -> str:
    return "action" if stream == "tick" else stream


def _split(array: NDArray[Any], rows: NDArray[np.int64]) -> list[Rows]:
    row_bytes = max(1, array.dtype.itemsize * int(np.prod(array.shape[1:])))
    step = max(1, CHUNK_BYTES // row_bytes)
    return [rows[start : start + step] for start in range(0, len(rows), step)]


def _readings(store: FeatureStore, ticks: Ticks, stream: str) -> list[Rows]:
    """The readings from each episode's start to the last of its ticks, where it has any."""
    starts = store.array(f"episode/{stream}_start")
    episode = store.episode_of(ticks)
    ends = np.array(starts, np.int64)
    np.maximum.at(ends, episode, store.array(f"tick/{stream}_end")[ticks].astype(np.int64))
    return [range(starts[index], ends[index]) for index in np.flatnonzero(ends > starts)]


def _chunk(store: FeatureStore, stream: str, rows: Rows) -> _Chunk:
    array = _array(store, stream)
    values = array[rows.start : rows.stop] if isinstance(rows, range) else array[rows]
    if values.dtype == np.uint16:
        values = torch.from_numpy(values).view(torch.bfloat16).float().numpy()
    valid = None
    if stream == "vl":
        slots = (-1, store.feature_shape[0])
        values = values.reshape(*slots, values.shape[-1])
        valid = store.array("vl/slot_valid")[rows].reshape(slots).astype(bool)
    return _Chunk(rows, values, valid)


def _array(store: FeatureStore, stream: str) -> NDArray[Any]:
    return store.array({"tick": "tick/action", "vl": "vl/features"}.get(stream, f"{stream}/values"))
