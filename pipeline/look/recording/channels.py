"""The values channel by channel: their statistics, and what looks wrong in them.

Issues are flat, still, frozen and saturated channels, and outliers.
"""

from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from pipeline.base.channels import PROFILE_CHANNELS, hardly_moving, named, unnumbered
from pipeline.base.config import Params
from pipeline.base.issue import Issue
from pipeline.base.table import Table
from pipeline.data import Channels, Stream
from pipeline.look.page.blocks import Block
from pipeline.look.recording.clocks import usual_step
from pipeline.look.recording.contact import force_columns
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
            yield from _flat(view, name, stream)
            # The depths of a scan are not all equally bright.
            still = None if name == "sensor" else still_channels(stream.channels, stream.values)
            if still is not None:
                yield view.issue("still channel", name, still[1], *_whole(stream))
    if view.sensor is not None and len(view.sensor.time) >= _FEWEST:
        yield from _frozen(view, view.sensor)
        yield from _saturated(view, view.sensor)
    if (line := view.timeline) is not None:
        ticks = Stream(line.action_channels, line.time, line.action)
        yield from _outliers(view, "action", "tick", ticks)
    if view.state is not None:
        yield from _outliers(view, "state", "row", view.state)


def still_channels(
    channels: Channels, values: NDArray[np.floating]
) -> tuple[list[int], str] | None:
    """Columns that hardly move beside others of their kind, such as joints, and their unit.

    And what is said of them; None where there are none. `values` are (row, channel).
    """
    names, varies = channels.names, np.ptp(values, axis=0) > 0
    std = np.where(varies, values.std(axis=0, dtype=np.float64), 0)
    usual = hardly_moving(std, names, channels.units)
    if not usual:
        return None
    columns = list(usual)
    largest = max(columns, key=lambda column: std[column] / usual[column])
    return columns, (
        f"{named(names, columns)} hardly move{'s' * (len(columns) == 1)}: a standard deviation of "
        f"{std[largest]:.2g} at most, where {usual[largest]:.2g} is usual for such channels; "
        "training scales every channel to unit spread, so that their noise would count like a "
        "motion"
    )


def _whole(stream: Stream) -> tuple[float, float]:
    return float(stream.time[0]), float(stream.time[-1])


def _flat(view: EpisodeView, name: str, stream: Stream) -> Iterator[Issue]:
    """Channels of one value; a gripper's is no issue: many tasks never move it."""
    flat = stream.values.max(axis=0) == stream.values.min(axis=0)
    names = stream.channels.names
    columns = [c for c in np.flatnonzero(flat).tolist() if "gripper" not in names[c].lower()]
    if not columns:
        return
    if len(columns) == 1:
        which = f"{names[columns[0]]} is {stream.values[0, columns[0]]:g} throughout"
    else:
        which = f"{len(columns)} of {len(names)} channels never change: {named(names, columns)}"
    others = "no channel varies" if flat.all() else "the others vary"
    yield view.issue("flat channel", name, f"{which}; {others}", *_whole(stream))


def _frozen(view: EpisodeView, sensor: Stream) -> Iterator[Issue]:
    """Spans in which the whole sensor, or all of it but the force, repeats one reading."""
    force = force_columns(sensor)
    others = [column for column in range(sensor.values.shape[1]) if column not in force]
    columns = others or force
    if (sensor.values.max(axis=0) == sensor.values.min(axis=0))[columns].all():
        return  # flat throughout, which is told already
    what = "all channels but the force" if force and others else "all channels"
    for start, stop in runs(_repeats(sensor.values, columns)):
        begin, end = float(sensor.time[start]), float(sensor.time[stop])
        if end - begin >= FROZEN_S:
            message = (
                f"{what} repeat one reading for {end - begin:.2f} s from {begin - view.zero:.2f} s "
                f"({stop - start + 1} readings); elsewhere they change"
            )
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
        message = (
            f"{stream.channels.names[column]} leaps to {values[worst, column]:.4g}{unit} at "
            f"{time[worst] - view.zero:.2f} s ({entry} {worst}; {len(places)} such {entry}s); all "
            f"others stay within {others.min():.4g} to {others.max():.4g}"
        )
        stop = float(time[places[-1]]) + usual_step(time)
        yield view.issue(f"{name} outlier", name, message, float(time[places[0]]), stop)


def _saturated(view: EpisodeView, sensor: Stream) -> Iterator[Issue]:
    """Channels that are clipped, in one line for each end of the range."""
    values, names = sensor.values, sensor.channels.names
    wide = _wide_columns(sensor)
    largest, smallest = values.max(axis=0), values.min(axis=0)
    for end, own, outermost in (("upper", largest, np.max), ("lower", smallest, np.min)):
        reached = own.copy()
        # Channels of one converter end at one value.
        if wide:
            reached[wide] = outermost(own[wide])
        at_end = (own == reached) & (own != 0) & (largest > smallest)
        standing = [
            column
            for column in np.flatnonzero(at_end).tolist()
            if (values[:, column] == own[column]).mean() >= CLIPPED_SHARE
            # What many depths reach together at most is no rest, however long one stands there.
            and ((end == "upper" and column in wide) or not _rests(sensor, column, own[column]))
        ]
        clipped = [column for column in standing if _clipped(values[:, column], own[column])]
        together = sum(column in wide for column in clipped) >= TOGETHER
        columns = [c for c in standing if (together if c in wide else c in clipped)]
        if not columns:
            continue
        places = np.flatnonzero((values[:, columns] == own[columns]).any(axis=1))
        first = values[places[0], columns]
        message = (
            f"{named(names, columns)} ({len(columns)} of {len(names)} channels) stand at the {end} "
            f"end of their range, {first[first == own[columns]][0]:g}, in "
            f"{100 * len(places) / len(values):.1f} % of the readings, first at "
            f"{sensor.time[places[0]] - view.zero:.2f} s; expected under {100 * CLIPPED_SHARE:g} %"
        )
        yield view.issue("saturated", "sensor", message, *sensor.time[places[[0, -1]]].tolist())


def _wide_columns(sensor: Stream) -> list[int]:
    """The channels beside the force, where they are many of one unit, such as an A-scan."""
    force = force_columns(sensor)
    columns = [c for c in range(len(sensor.channels.names)) if c not in force]
    one_unit = len({sensor.channels.units[column] for column in columns}) == 1
    return columns if one_unit and len(columns) >= _WIDE else []


def _rests(sensor: Stream, column: int, end: np.float32) -> bool:
    """Whether a channel rests at an end, as a force does at zero load.

    It stands there when the recording begins; or mostly, and the other end is farther from zero.
    """
    values = sensor.values[:, column]
    if np.median(values[sensor.time <= sensor.time[0] + REST_S]) == end:
        return True
    mostly = abs(float(end) - float(np.median(values))) <= AT_REST * float(np.ptp(values))
    return mostly and abs(end) < np.abs(values).max()


def _clipped(values: NDArray[np.float32], end: np.float32) -> bool:
    """Whether far more readings stand at the end than at the value next to it, some in a row.

    A channel of two values is a switch, which has no value next to its end.
    """
    at_end = values == end
    others = values[~at_end]
    if others.min() == others.max() or max(b - a for a, b in runs(at_end)) < CLIPPED_RUN:
        return False
    beside = others[np.argmin(np.abs(others - end))]
    return bool(np.count_nonzero(at_end) >= PILED_UP * np.count_nonzero(others == beside))


# Channels worked on at a time: sorting copies what it looks at.
_COLUMNS = 16
_HEADS = (
    *("stream", "channel", "unit", "count"),
    *("min", "1 %", "median", "99 %", "max", "mean", "std"),
)


@dataclass(frozen=True)
class ChannelStatistics:
    """One channel over one episode; `low` and `high` are the first and 99th percentile."""

    stream: str
    name: str
    unit: str
    count: int
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
    """Statistics of every channel that could be read, over all of the episode's entries.

    Streams `sensor`, `state`, `poses` where they are not columns of the state, and `action`: what
    the ticks have, which is derived from poses in some formats; as recorded where there is no tick.
    """
    line = view.timeline
    for name, stream in view.streams.items():
        shown_below = name == "action" and line is not None
        if not shown_below and not (name == "poses" and view.poses_are_state):
            channels = stream.channels
            yield from statistics_of(name, channels.names, channels.units, stream.values)
    if line is not None:
        channels = line.action_channels
        yield from statistics_of("action", channels.names, channels.units, line.action)


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
    for _, like in groupby(statistics, lambda one: (one.stream, unnumbered(one.name), one.unit)):
        group = [astuple(one) for one in like]
        rows += group if len(group) < PROFILE_CHANNELS else [_joint_row(group)]
    caption = "Over the whole episode, before any normalisation."
    if len(rows) < len(statistics):
        caption += (
            " A row of many channels shows the lowest minimum, the highest maximum, and of the rest"
            " the median over the channels."
        )
    return Table(_HEADS, rows, caption)


def _joint_row(group: Sequence[tuple[object, ...]]) -> tuple[object, ...]:
    (stream, first, unit, count, *_), last = group[0], group[-1][1]
    points = np.array([row[4:] for row in group], np.float64)
    joint = np.median(points, axis=0)
    joint[0], joint[4] = points[:, 0].min(), points[:, 4].max()
    name = f"{first} … {last} ({len(group):,} channels)"
    return stream, name, unit, count, *joint.tolist()
