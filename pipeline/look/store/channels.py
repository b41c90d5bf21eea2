"""The channels of state, sensor and action over a whole store, in bounded memory."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline.base.channels import PROFILE_CHANNELS, named, unnumbered
from pipeline.base.issue import Issue
from pipeline.data import Channels
from pipeline.look.page.blocks import Block, Picture, Text
from pipeline.look.page.style import GRID, PALETTE, finish, panels
from pipeline.look.recording.channels import (
    ChannelStatistics,
    describe_still,
    statistics_of,
    statistics_table,
)
from pipeline.store import FeatureStore

SAMPLE_BYTES = 64 * 2**20
"""Of float32 values that are in memory at a time."""
_ARRAYS = {"action": "tick/action", "state": "state/values", "sensor": "sensor/values"}


@dataclass(frozen=True)
class StreamSummary:
    """One stream over all episodes."""

    stream: str
    rows: int
    """Readings (ticks, of the action) in the store."""
    looked_at: int
    """Of these, evenly spread; what the statistics are of."""
    channels: tuple[ChannelStatistics, ...]
    still: str
    """What is wrong with channels that hardly move, as of a recording; never of the sensor."""


def summarize_streams(
    store: FeatureStore, sample_bytes: int = SAMPLE_BYTES
) -> tuple[StreamSummary, ...]:
    """Of action, state and sensor, those that the store has.

    Of a stream that is larger than `sample_bytes` as float32, evenly spread readings are looked at:
    extremes that last shorter than the step between two can be missed.
    """
    statistics: list[StreamSummary] = []
    for stream, name in _ARRAYS.items():
        values = store.array(name)
        total = len(values)
        if values.size:
            document = store.streams[stream]
            channels = Channels(tuple(document["names"]), tuple(document["units"]))
            rows = evenly(total, max(2, sample_bytes // (4 * values.shape[1])))
            values = values[rows]
            by_channel = tuple(statistics_of(stream, channels.names, channels.units, values))
            still = "" if stream == "sensor" else describe_still(channels, values)
            statistics.append(StreamSummary(stream, total, len(rows), by_channel, still))
    return tuple(statistics)


def evenly(total: int, most: int) -> NDArray[np.int64]:
    """At most `most` of `total` indices, ascending and evenly spread."""
    count = min(total, most)
    return np.arange(count, dtype=np.int64) * total // max(1, count)


def show_channels(statistics: Sequence[StreamSummary]) -> list[Block]:
    """How much was looked at, the profiles as a picture, and every channel in a table."""
    looked_at = [f"{one.looked_at:,} of {one.rows:,} rows of {one.stream}" for one in statistics]
    blocks: list[Block] = [
        Text(f"Of the whole store. Looked at, evenly: {', '.join(looked_at)}."),
        statistics_table([channel for summary in statistics for channel in summary.channels]),
    ]
    if profiles := list(find_profiles(statistics)):
        caption = "Numbered channels side by side: median, 1 to 99 %, least and greatest."
        blocks.insert(1, Picture("wide_channels", caption, partial(draw_profiles, profiles)))
    return blocks


def find_profiles(statistics: Sequence[StreamSummary]) -> Iterator[tuple[ChannelStatistics, ...]]:
    """Runs of channels that make a profile, such as an A-scan."""
    for stream in statistics:
        runs = groupby(stream.channels, lambda channel: (unnumbered(channel.name), channel.unit))
        for channels in (tuple(run) for _, run in runs):
            if len(channels) >= PROFILE_CHANNELS:
                yield channels


def draw_profiles(profiles: Sequence[Sequence[ChannelStatistics]]) -> Figure:
    """Every channel of each profile: median, 1 to 99 %, and extremes."""
    size = 8.5, 0.6 + 2.6 * len(profiles)
    figure, axes = panels(*size, len(profiles), 1, squeeze=False)
    for axis, channels in zip(axes[:, 0], profiles, strict=True):
        at, first = np.arange(len(channels)), channels[0]
        ends = [(one.minimum, one.maximum) for one in channels]
        inner = [(one.low, one.high) for one in channels]
        axis.fill_between(at, *np.transpose(ends), color=GRID, label="least to greatest")
        style = {"color": PALETTE[4], "alpha": 0.5, "lw": 0}
        axis.fill_between(at, *np.transpose(inner), label="1 to 99 %", **style)
        axis.plot(at, [one.median for one in channels], color=PALETTE[0], lw=1.2, label="median")
        axis.set_ylabel(f"{first.stream} [{first.unit}]" if first.unit else first.stream)
        axis.set_xlabel(f"channel: {first.name} to {channels[-1].name}")
        axis.margins(x=0)
    finish(figure, axes[0, 0], 3)
    return figure


def find_channel_issues(statistics: Sequence[StreamSummary]) -> Iterator[Issue]:
    """Channels that never change, hardly move, or hold what is no number."""
    for stream in statistics:
        names, rows = [one.name for one in stream.channels], f"{stream.looked_at} rows looked at"
        broken = [at for at, channel in enumerate(stream.channels) if not np.isfinite(channel.mean)]
        # The gripper of pose-derived actions is 1 by definition.
        flat = [
            at
            for at, channel in enumerate(stream.channels)
            if channel.minimum == channel.maximum
            and (channel.name, channel.minimum) != ("gripper", 1)
        ]
        texts = {
            "flat channel": f"{named(names, flat)}: one value in all {rows}" if flat else "",
            "still channel": stream.still,
            "not finite": f"{named(names, broken)}: NaN or infinite in {rows}" if broken else "",
        }
        for kind, text in texts.items():
            severity = "error" if kind == "not finite" else "warning"
            if text:
                yield Issue(severity=severity, kind=kind, message=text, stream=stream.stream)
