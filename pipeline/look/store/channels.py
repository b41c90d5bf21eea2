"""The channels of state, sensor and action over a whole store, in bounded memory."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline.base.channels import PROFILE_CHANNELS, named, unnumbered
from pipeline.base.issue import Issue
from pipeline.data import Channels
from pipeline.look.page.blocks import Block, Picture, Text
from pipeline.look.page.style import GRID, PALETTE, canvas
from pipeline.look.recording.channel_flaws import still_channels
from pipeline.look.recording.facts import ChannelStatistics
from pipeline.look.recording.page_statistics import statistics_table
from pipeline.look.recording.statistics import statistics_of
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
    still: str
    """What is wrong with channels that hardly move, as of a recording; never of the sensor."""


def stream_statistics(
    store: FeatureStore, sample_bytes: int = SAMPLE_BYTES
) -> tuple[StreamStatistics, ...]:
    """Of action, state and sensor, those that the store has.

    Of a stream that is larger than `sample_bytes` as float32, evenly spread readings are looked at:
    extremes that last shorter than the step between two can be missed.
    """
    statistics: list[StreamStatistics] = []
    for stream, name in _ARRAYS.items():
        values = store.array(name)
        total = len(values)
        if values.size:
            document = store.streams[stream]
            channels = Channels(tuple(document["names"]), tuple(document["units"]))
            rows = evenly(total, max(2, sample_bytes // (4 * values.shape[1])))
            values = values[rows]
            one_by_one = tuple(statistics_of(stream, channels.names, channels.units, values))
            still = None if stream == "sensor" else still_channels(channels, values)
            told = "" if still is None else still[1]
            statistics.append(StreamStatistics(stream, total, len(rows), one_by_one, told))
    return tuple(statistics)


def evenly(total: int, most: int) -> NDArray[np.int64]:
    """At most `most` of `total` indices, ascending and evenly spread."""
    count = min(total, most)
    return np.arange(count, dtype=np.int64) * total // max(1, count)


def channel_blocks(statistics: Sequence[StreamStatistics]) -> list[Block]:
    """How much was looked at, the profiles as a picture, and every channel in a table."""
    looked_at = ", ".join(
        f"{one.stream}: all {one.rows:,} rows"
        if one.looked_at == one.rows
        else f"{one.stream}: {one.looked_at:,} of {one.rows:,}, evenly spread"
        for one in statistics
    )
    table = statistics_table([channel for one in statistics for channel in one.channels])
    blocks: list[Block] = [
        Text(f"Over the whole store, before any normalisation. Looked at: {looked_at}."),
        replace(table, caption=table.caption.replace("Over the whole episode", "Physical units")),
    ]
    if profiles := list(numbered_channels(statistics)):
        caption = "Numbered channels side by side: median, 1 to 99 %, least and greatest."
        blocks.insert(1, Picture("wide_channels", caption, partial(draw_profiles, profiles)))
    return blocks


def numbered_channels(
    statistics: Sequence[StreamStatistics],
) -> Iterator[tuple[ChannelStatistics, ...]]:
    """Runs of channels that make a profile, such as an A-scan."""
    for stream in statistics:
        for _, run in groupby(stream.channels, key=lambda one: (unnumbered(one.name), one.unit)):
            channels = tuple(run)
            if len(channels) >= PROFILE_CHANNELS:
                yield channels


def draw_profiles(profiles: Sequence[Sequence[ChannelStatistics]]) -> Figure:
    """Every channel of each profile: median, 1 to 99 %, and extremes."""
    figure = canvas(8.5, 0.6 + 2.6 * len(profiles))
    axes = figure.subplots(len(profiles), 1, squeeze=False)[:, 0]
    for axis, channels in zip(axes, profiles, strict=True):
        _band(axis, channels)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def _band(axis: Axes, channels: Sequence[ChannelStatistics]) -> None:
    at, first = np.arange(len(channels)), channels[0]
    lines = [(one.minimum, one.low, one.median, one.high, one.maximum) for one in channels]
    minimum, low, median, high, maximum = np.array(lines).T
    axis.fill_between(at, minimum, maximum, color=GRID, label="least to greatest")
    axis.fill_between(at, low, high, color=PALETTE[4], alpha=0.5, lw=0, label="1 to 99 %")
    axis.plot(at, median, color=PALETTE[0], lw=1.2, label="median")
    axis.set_ylabel(f"{first.stream} [{first.unit}]" if first.unit else first.stream)
    axis.set_xlabel(f"channel: {first.name} to {channels[-1].name}")
    axis.margins(x=0)


def channel_issues(statistics: Sequence[StreamStatistics]) -> Iterator[Issue]:
    """Channels that never change, hardly move, or hold what is no number."""
    for stream in statistics:
        issue = partial(Issue, stream=stream.stream)
        channels, names = stream.channels, [one.name for one in stream.channels]
        # The gripper of pose-derived actions is 1 by definition.
        flat = [
            at
            for at, one in enumerate(channels)
            if one.minimum == one.maximum and (one.name, one.minimum) != ("gripper", 1)
        ]
        if flat:
            told = f"{named(names, flat)}: one value in all {stream.looked_at} rows looked at"
            yield issue(severity="warning", kind="flat channel", message=told)
        if stream.still:
            yield issue(severity="warning", kind="still channel", message=stream.still)
        broken = [at for at, one in enumerate(channels) if not np.isfinite(one.mean)]
        if broken:
            told = f"{named(names, broken)}: NaN or infinite in {stream.looked_at} rows looked at"
            yield issue(severity="error", kind="not finite", message=told)
