"""Per-channel statistics of one episode."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pipeline.inspection.facts import ChannelStatistics, EpisodeView
from pipeline.recordings import Channels

_COLUMNS = 64
"""Channels worked on at a time: percentiles copy what they look at."""


def channel_statistics(view: EpisodeView) -> tuple[ChannelStatistics, ...]:
    """Statistics of every channel that could be read, over all of the episode's entries.

    Streams `sensor`, `state`, `poses` where they are not columns of the state, and `action`: what
    the ticks have, which is derived from poses in some formats; as recorded where there is no tick.
    """
    return tuple(one for stream in _streams(view) for one in _statistics(*stream))


def _streams(view: EpisodeView) -> Iterator[tuple[str, Channels, NDArray[np.float32]]]:
    for name, stream in view.streams.items():
        state = view.state.channels.names if view.state is not None else ()
        if name == "poses" and set(stream.channels.names) <= set(state):
            continue
        if name == "action" and view.timeline is not None:
            continue
        yield name, stream.channels, stream.values
    if view.timeline is not None:
        yield "action", view.timeline.action_channels, view.timeline.action


def _statistics(
    stream: str, channels: Channels, values: NDArray[np.float32]
) -> Iterator[ChannelStatistics]:
    for first in range(0, values.shape[1], _COLUMNS):
        block = values[:, first : first + _COLUMNS].astype(np.float64)
        points = np.percentile(block, [0, 1, 50, 99, 100], axis=0)
        mean, std = block.mean(axis=0), block.std(axis=0)
        for column in range(block.shape[1]):
            minimum, low, median, high, maximum = map(float, points[:, column])
            yield ChannelStatistics(
                stream=stream,
                name=channels.names[first + column],
                unit=channels.units[first + column],
                count=len(block),
                minimum=minimum,
                low=low,
                median=median,
                high=high,
                maximum=maximum,
                mean=float(mean[column]),
                std=float(std[column]),
            )
