"""Statistics of the channels of state, sensor and action over a whole store, in bounded memory."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.inspection.facts import ChannelStatistics
from pipeline.store import FeatureStore

SAMPLE_BYTES = 64 * 2**20
"""Of float32 values that are in memory at a time."""
_ARRAYS = {"action": "tick/action", "state": "state/values", "sensor": "sensor/values"}
_LOW, _HIGH = 0.01, 0.99


@dataclass(frozen=True)
class StreamStatistics:
    """One stream over all episodes."""

    stream: str
    rows: int
    """Readings (ticks, of the action) in the store."""
    looked_at: int
    """Of these, evenly spread; what the statistics are of."""
    channels: tuple[ChannelStatistics, ...]


def stream_statistics(
    store: FeatureStore, sample_bytes: int = SAMPLE_BYTES
) -> tuple[StreamStatistics, ...]:
    """Of action, state and sensor, those that the store has.

    Of a stream that is larger than `sample_bytes` as float32, evenly spread readings are looked at:
    extremes that last shorter than the step between two can be missed.
    """
    found: list[StreamStatistics] = []
    for stream, name in _ARRAYS.items():
        values = store.array(name)
        if values.size:
            said = store.streams[stream]
            rows = evenly(len(values), max(2, sample_bytes // (4 * values.shape[1])))
            sample = values[rows].astype(np.float32)
            channels = _channels(stream, sample, said["names"], said["units"])
            found.append(StreamStatistics(stream, len(values), len(rows), channels))
    return tuple(found)


def evenly(total: int, most: int) -> NDArray[np.int64]:
    """At most `most` of `total` indices, ascending and evenly spread."""
    count = min(total, most)
    return np.arange(count, dtype=np.int64) * total // max(1, count)


def _channels(
    stream: str, sample: NDArray[np.float32], names: Sequence[str], units: Sequence[str]
) -> tuple[ChannelStatistics, ...]:
    mean, std = sample.mean(axis=0, dtype=np.float64), sample.std(axis=0, dtype=np.float64)
    columns = np.stack(
        [
            sample.min(axis=0),
            *np.quantile(sample, (_LOW, 0.5, _HIGH), axis=0, overwrite_input=True),
            sample.max(axis=0),
            mean,
            std,
        ]
    ).T.tolist()
    return tuple(
        ChannelStatistics(stream, name, unit, len(sample), *numbers)
        for name, unit, numbers in zip(names, units, columns, strict=True)
    )
