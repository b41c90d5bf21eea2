"""Statistics of the channels of state, sensor and action over a whole store, in bounded memory."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data import Channels
from pipeline.look.recording.channels import ChannelStatistics, statistics_of, still_channels
from pipeline.store import FeatureStore

SAMPLE_BYTES = 64 * 2**20
"""Of float32 values that are in memory at a time."""
_ARRAYS = {"action": "tick/action", "state": "state/values", "sensor": "sensor/values"}


@dataclass(frozen=True)
class StreamStatistics:
    """One stream over all episodes."""

    stream: str
    rows: int
    """Readings (ticks, of the action) in the store."""
    looked_at: int
    """Of these, evenly spread; what the statistics are of."""
    channels: tuple[ChannelStatistics, ...]
    still: tuple[list[int], str] | None
    """Channels that hardly move, as of a recording; never of the sensor."""


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
        total = len(values)
        if values.size:
            said = store.streams[stream]
            rows = evenly(total, max(2, sample_bytes // (4 * values.shape[1])))
            names, units, values = said["names"], said["units"], values[rows]
            channels = tuple(statistics_of(stream, names, units, values))
            named = Channels(tuple(names), tuple(units))
            still = None if stream == "sensor" else still_channels(named, values)
            found.append(StreamStatistics(stream, total, len(rows), channels, still))
    return tuple(found)


def evenly(total: int, most: int) -> NDArray[np.int64]:
    """At most `most` of `total` indices, ascending and evenly spread."""
    count = min(total, most)
    return np.arange(count, dtype=np.int64) * total // max(1, count)
