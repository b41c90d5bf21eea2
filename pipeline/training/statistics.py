"""The normalisation, fitted on what training may see and nothing else."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.batches import Ticks
from pipeline.normalization import ChannelStatistics, Normalization, fit_channels
from pipeline.store import FeatureStore

CHUNK_BYTES = 64 * 2**20
Values = NDArray[np.floating]


def fit_normalization(store: FeatureStore, ticks: Ticks) -> Normalization:
    """Statistics per channel over the training `ticks` and what was known at them.

    Features over the VL rows that these ticks use, each once; sensor and state over the readings
    from each episode's start to the last of its ticks; a stream that none of them has, has none.
    Reads the store once, a chunk of about 64 MB at a time. Raises `NumericsError` on NaN or inf.
    """
    actions = _rows(store.array("tick/action"), ticks)
    return Normalization(
        action=fit_channels(actions, "training actions", store.streams["action"]["names"]),
        features=fit_channels(_features(store, ticks), "training features"),
        **{stream: _fit_stream(store, ticks, stream) for stream in ("sensor", "state")},
    )


def _fit_stream(store: FeatureStore, ticks: Ticks, stream: str) -> ChannelStatistics | None:
    names = store.streams[stream]["names"]
    if not any(len(readings) for readings in _readings(store, ticks, stream)):
        return None
    return fit_channels(_readings(store, ticks, stream), f"training readings of {stream}", names)


def _features(store: FeatureStore, ticks: Ticks) -> Iterator[tuple[Values, NDArray[np.bool_]]]:
    rows = np.unique(store.array("tick/vl_row")[ticks])
    valid = store.array("vl/slot_valid")
    done = 0
    for values in _rows(store.array("vl/features"), rows):
        if values.dtype == np.uint16:
            values = torch.from_numpy(values).view(torch.bfloat16).float().numpy()
        yield values, valid[rows[done : done + len(values)]].astype(bool)
        done += len(values)


def _readings(store: FeatureStore, ticks: Ticks, stream: str) -> Iterator[Values]:
    values = store.array(f"{stream}/values")
    starts = store.array(f"episode/{stream}_start")
    episode = np.searchsorted(store.array("episode/tick_start"), ticks, side="right") - 1
    for index in np.unique(episode):
        end = int(store.array(f"tick/{stream}_end")[ticks[episode == index].max()])
        yield values[int(starts[index]) : end]


def _rows(array: NDArray[Any], rows: NDArray[np.int64]) -> Iterator[NDArray[Any]]:
    row_bytes = max(1, array.dtype.itemsize * int(np.prod(array.shape[1:])))
    step = max(1, CHUNK_BYTES // row_bytes)
    for start in range(0, len(rows), step):
        yield array[rows[start : start + step]]
