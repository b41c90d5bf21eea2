"""The values channel by channel: their statistics, and what looks wrong in them.

Issues are flat, still, frozen and saturated channels, and outliers.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from pipeline.base.channels import PROFILE_CHANNELS, hardly_moving, named, unnumbered
from pipeline.base.config import Params
from pipeline.base.issue import Issue
from pipeline.base.table import Table
from pipeline.data import Channels, Stream
from pipeline.data.contact import force_columns
from pipeline.look.page.blocks import Block
from pipeline.look.recording.clocks import usual_step
from pipeline.look.recording.episode import Draw, EpisodeView, runs

# A sensor whose channels all repeat for as long stands still.
FROZEN_S = 0.5
# Times the 95th percentile of how far entries depart from their neighbours; and farther than all
# others are apart.
OUTLIER = 20.0
# Share of a channel's readings at the end of its range, and how many of them in a row.
CLIPPED_SHARE, CLIPPED_RUN = 0.01, 5
# Times as many readings at the end of the range as at the value next to it.
PILED_UP = 3
# Channels of one converter that are clipped at least: what is bright enough for one is wide.
TOGETHER = 3
# For as long at the start a channel may rest at its end; share of the range that is near it.
REST_S, AT_REST = 0.5, 0.2

# Channels of one unit, from which their common largest value is taken for the end of the range.
_WIDE = 8
# Entries below which nothing is said of a stream's values.
_FEWEST = 20
_NEIGHBOURS = 5


def find_channel_issues(view: EpisodeView) -> Iterator[Issue]:
    """Issues of kind flat channel, still channel, frozen, saturated, action and state outlier."""
    for name, stream in view.streams.items():
        if name != "poses" and len(stream.time) >= _FEWEST:
            if flat := _describe_flat(stream):
                yield view.issue("flat channel", name, flat)
            # The depths of a scan are not all equally bright.
            if name != "sensor" and (still := describe_still(stream.channels, stream.values)):
                yield view.issue("still channel", name, still)
    if view.sensor is not None and len(view.sensor.time) >= _FEWEST:
        yield from _frozen(view, view.sensor)
        yield from _saturated(view, view.sensor)
    if view.timeline is not None:
        yield from _outliers(view, "action", "tick", view.shown["action"])
    if view.state is not None:
        yield from _outliers(view, "state", "row", view.state)


def describe_still(channels: Channels, values: NDArray[np.floating]) -> str:
    """Names channels that hardly move beside others of their kind, such as joints; '' for none.

    `values` are (row, channel).
    """
    names, varies = channels.names, np.ptp(values, axis=0) > 0
    std = np.where(varies, values.std(axis=0, dtype=np.float64), 0)
    usual = hardly_moving(std, names, channels.units)
    if not usual:
        return ""
    largest = max(usual, key=lambda column: std[column] / usual[column])
    return (
        f"{named(names, [*usual])} hardly move{'s' * (len(usual) == 1)}: a standard deviation of "
        f"{std[largest]:.2g} at most, where {usual[largest]:.2g} is usual for such channels"
    )


def _describe_flat(stream: Stream) -> str:
    """Names channels of one value; a gripper's is no issue: many tasks never move it."""
    flat = np.ptp(stream.values, axis=0) == 0
    names = stream.channels.names
    columns = [c for c in np.flatnonzero(flat).tolist() if "gripper" not in names[c].lower()]
    if not columns:
        return ""
    return f"{len(columns)} of {len(names)} channels never change: {named(names, columns)}"


def _frozen(view: EpisodeView, sensor: Stream) -> Iterator[Issue]:
    """Spans in which the whole sensor, or all of it but the force, repeats one reading."""
    force = force_columns(sensor.channels.names)
    columns = [column for column in range(sensor.values.shape[1]) if column not in force] or force
    if not np.ptp(sensor.values, axis=0)[columns].any():
        return  # flat throughout, which is told already
    what = "all channels" if columns == force or not force else "all channels but the force"
    for start, stop in runs(_repeats(sensor.values, columns)):
        begin, end = float(sensor.time[start]), float(sensor.time[stop])
        if end - begin >= FROZEN_S:
            message = f"{what} repeat one reading {stop - start + 1} times; elsewhere they change"
            yield view.issue("frozen", "sensor", message, begin, end)


def _repeats(values: NDArray[np.float32], columns: Sequence[int]) -> NDArray[np.bool_]:
    """(reading - 1,) whether a reading is that before, in these columns."""
    same = np.ones(len(values) - 1, np.bool_)
    for column in columns:
        # Only where all columns so far repeat: soon there are few such places.
        places = np.flatnonzero(same)
        same[places] = values[places, column] == values[places + 1, column]
    return same


def _outliers(view: EpisodeView, name: str, entry: str, stream: Stream) -> Iterator[Issue]:
    """Single entries that leap off and back, unlike anything else in the episode."""
    time, values = stream.time, stream.values.astype(np.float64)
    if len(time) < _FEWEST:
        return
    # Mirrored, so that the first and the last entry have neighbours to depart from.
    away = np.abs(values - median_filter(values, size=(_NEIGHBOURS, 1), mode="mirror"))
    usual = np.percentile(away, 95, axis=0)
    for column in np.flatnonzero(usual > 0).tolist():
        places = np.flatnonzero(away[:, column] > OUTLIER * usual[column])
        others = np.delete(values[:, column], places)
        places = places[away[places, column] > np.ptp(others)]
        if not len(places):
            continue
        worst = int(places[np.argmax(away[places, column])])
        unit = f" {stream.channels.units[column]}".rstrip()
        leap = f"{stream.channels.names[column]} leaps to {values[worst, column]:.4g}{unit}"
        rest = f"all others stay within {others.min():.4g} to {others.max():.4g}"
        message = f"{leap} ({entry} {worst}; {len(places)} such {entry}s); {rest}"
        stop = float(time[places[-1]]) + usual_step(time)
        yield view.issue(f"{name} outlier", name, message, float(time[places[0]]), stop)


def _saturated(view: EpisodeView, sensor: Stream) -> Iterator[Issue]:
    """Channels that are clipped, a line for each end of the range."""
    names, force = sensor.channels.names, force_columns(sensor.channels.names)
    wide = [column for column in range(len(names)) if column not in force]
    if len({sensor.channels.units[column] for column in wide}) != 1 or len(wide) < _WIDE:
        wide = []
    # Channels of one converter end at one value.
    groups = [wide] * bool(wide) + [[c] for c in range(len(names)) if c not in wide]
    for end, outermost in (("upper", np.max), ("lower", np.min)):
        ends = outermost(sensor.values, axis=0)
        columns = [c for group in groups for c in _clipped(sensor, group, ends, outermost)]
        if not columns:
            continue
        places = np.flatnonzero((sensor.values[:, columns] == ends[columns]).any(axis=1))
        which = f"{named(names, columns)} ({len(columns)} of {len(names)} channels)"
        at = f"stand at the {end} end of their range, {ends[columns[0]]:g}"
        message = f"{which} {at}, in {100 * len(places) / len(sensor.time):.1f} % of the readings"
        yield view.issue("saturated", "sensor", message, *sensor.time[places[[0, -1]]].tolist())


def _clipped(
    sensor: Stream, columns: list[int], ends: NDArray[np.floating], outermost: Callable[..., Any]
) -> list[int]:
    """Those of these columns that stand at the end of their common range, else none.

    Far more readings stand there than at the value next to it, some in a row; of many columns in
    `TOGETHER` at least. A channel of two values is a switch, which has no value next to its end.
    """
    end, standing, clipped = outermost(ends[columns]), list[int](), 0
    for column in columns:
        values = sensor.values[:, column]
        at_end = values == end
        if end == 0 or at_end.mean() < CLIPPED_SHARE or at_end.all():
            continue
        # What many depths reach together at most is no rest, however long one stands there.
        if (len(columns) == 1 or outermost is np.min) and _rests(sensor, column, end):
            continue
        standing.append(column)
        others = values[~at_end]
        beside = np.count_nonzero(others == outermost(others))
        in_a_row = max(stop - start for start, stop in runs(at_end)) >= CLIPPED_RUN
        several = others.min() < others.max()
        clipped += several and in_a_row and np.count_nonzero(at_end) >= PILED_UP * beside
    return standing if clipped >= min(TOGETHER, len(columns)) else []


def _rests(sensor: Stream, column: int, end: np.float32) -> bool:
    """Whether a channel rests at an end, as a force does at zero load.

    It stands there when the recording begins; or mostly, and the other end is farther from zero.
    """
    values = sensor.values[:, column]
    if np.median(values[sensor.time <= sensor.time[0] + REST_S]) == end:
        return True
    mostly = abs(float(end) - float(np.median(values))) <= AT_REST * float(np.ptp(values))
    return mostly and abs(end) < np.abs(values).max()


# Channels worked on at a time: sorting copies what it looks at.
_COLUMNS = 16
_HEADS = (
    *("stream", "channel", "unit", "count"),
    *("min", "1 %", "median", "99 %", "max", "mean", "std"),
)


class ChannelStatistics(NamedTuple):
    """One channel over one episode; `low` and `high` are the first and 99th percentile."""

    stream: str
    name: str
    unit: str
    readings: int
    minimum: float
    low: float
    median: float
    high: float
    maximum: float
    mean: float
    std: float


def statistics_blocks(view: EpisodeView, draw: Draw, params: Params) -> list[Block]:
    """The table of every channel that could be read; empty without any."""
    statistics = list(channel_statistics(view))
    return [statistics_table(statistics)] if statistics else []


def channel_statistics(view: EpisodeView) -> Iterator[ChannelStatistics]:
    """Statistics of every channel that a page shows, over all of the episode's entries."""
    for name, stream in view.shown.items():
        yield from statistics_of(name, stream.channels.names, stream.channels.units, stream.values)


def statistics_of(
    stream: str, names: Sequence[str], units: Sequence[str], values: NDArray[np.floating]
) -> Iterator[ChannelStatistics]:
    """Of each channel of `values` (reading, channel), which stay as they are."""
    for first in range(0, values.shape[1], _COLUMNS):
        block = values[:, first : first + _COLUMNS].astype(np.float64)
        points = np.percentile(block, (0, 1, 50, 99, 100), axis=0)
        rows = np.concatenate([points, [block.mean(axis=0), block.std(axis=0)]]).T.tolist()
        for column, row in enumerate(rows, start=first):
            yield ChannelStatistics(stream, names[column], units[column], len(values), *row)


def statistics_table(statistics: Sequence[ChannelStatistics]) -> Table:
    """A row a channel; channels that differ by a number in their names are one from 24 on."""
    rows: list[tuple[object, ...]] = []
    for _, like in groupby(statistics, lambda c: (c.stream, unnumbered(c.name), c.unit)):
        group = list(like)
        rows += group if len(group) < PROFILE_CHANNELS else [_joint_row(group)]
    caption = "Of many channels in a row: the extremes of all, else the median over the channels."
    return Table(_HEADS, rows, caption)


def _joint_row(group: Sequence[tuple[object, ...]]) -> tuple[object, ...]:
    (stream, first, unit, count, *_), last = group[0], group[-1][1]
    points = np.array([row[4:] for row in group], np.float64)
    joint = np.median(points, axis=0)
    joint[0], joint[4] = points[:, 0].min(), points[:, 4].max()
    name = f"{first} … {last} ({len(group):,} channels)"
    return stream, name, unit, count, *joint.tolist()
