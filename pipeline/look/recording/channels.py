"""The values channel by channel: their statistics, and what looks wrong in them."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from pipeline.base.channels import hardly_moving, named
from pipeline.base.config import Params
from pipeline.base.issue import Issue
from pipeline.base.table import Table
from pipeline.data import Stream
from pipeline.data.contact import force_columns
from pipeline.look.page.blocks import Block
from pipeline.look.recording.clocks import usual_step
from pipeline.look.recording.episode import Draw, EpisodeView, runs
from pipeline.look.recording.streams import group_channels, named_groups

# A sensor whose channels all repeat for as long is frozen.
FROZEN_S = 0.5
# An outlier is as many times as far from its neighbours as 95 % of the entries are, and farther
# than all others are apart.
OUTLIER = 20.0
# A clipped channel has this share of its readings at its end, and as many of them in a row.
CLIPPED_SHARE, CLIPPED_RUN = 0.01, 5
# Times as many readings at the end as at the value next to it.
PILED_UP = 3
# Channels of a profile that are clipped at least: a bright echo is a few channels wide.
TOGETHER = 3
# A channel that begins at its end for as long rests there.
REST_S = 0.5

# Entries from which values are judged.
_FEWEST = 20
_NEIGHBOURS = 5
# Channels worked on at a time: sorting copies them.
_COLUMNS = 16


def find_channel_issues(view: EpisodeView) -> Iterator[Issue]:
    """Issues of kind flat channel, still channel, frozen, saturated, action and state outlier."""
    for name, stream in view.streams.items():
        if name != "poses" and len(stream.time) >= _FEWEST:
            yield from _unmoved(view, name, stream)
    if view.sensor is not None and len(view.sensor.time) >= _FEWEST:
        yield from _frozen(view, view.sensor)
        yield from _saturated(view, view.sensor)
    if view.timeline is not None:
        yield from _outliers(view, "action", "tick", view.shown["action"])
    if view.state is not None:
        yield from _outliers(view, "state", "row", view.state)


def _unmoved(view: EpisodeView, name: str, stream: Stream) -> Iterator[Issue]:
    """Channels of one value, and channels that hardly move beside others of their kind."""
    names, values = stream.channels.names, stream.values
    varies = np.ptp(values, axis=0) > 0
    # Many tasks never move the gripper.
    flat = [c for c in np.flatnonzero(~varies).tolist() if "gripper" not in names[c].lower()]
    if flat:
        message = f"{len(flat)} of {len(names)} channels never change: {named(names, flat)}"
        yield view.issue("flat channel", name, message)
    if name == "sensor":  # the depths of a scan are not equally bright
        return
    std = np.where(varies, values.std(axis=0, dtype=np.float64), 0)
    if usual := hardly_moving(std, names, stream.channels.units):
        largest = max(usual, key=lambda column: std[column] / usual[column])
        message = (
            f"{named(names, [*usual])} hardly move{'s' * (len(usual) == 1)}: a standard deviation "
            f"of {std[largest]:.2g} at most, where {usual[largest]:.2g} is usual for such channels"
        )
        yield view.issue("still channel", name, message)


def _frozen(view: EpisodeView, sensor: Stream) -> Iterator[Issue]:
    """Spans in which the whole sensor, or all of it but the force, repeats one reading."""
    force = force_columns(sensor.channels.names)
    columns = [column for column in range(sensor.values.shape[1]) if column not in force] or force
    if not np.ptp(sensor.values, axis=0)[columns].any():
        return  # flat channels throughout
    what = "all channels" if columns == force or not force else "all channels but the force"
    for start, stop in runs(_repeats(sensor.values, columns)):
        begin, end = float(sensor.time[start]), float(sensor.time[stop])
        if end - begin >= FROZEN_S:
            message = f"{what} repeat one reading {stop - start + 1} times; elsewhere they change"
            yield view.issue("frozen", "sensor", message, begin, end)


def _repeats(values: NDArray[np.float32], columns: Sequence[int]) -> NDArray[np.bool_]:
    """(reading - 1,) whether a reading equals the one before, in these columns."""
    same = np.ones(len(values) - 1, np.bool_)
    for column in columns:
        # Only where all columns so far repeat: soon there are few such places.
        places = np.flatnonzero(same)
        same[places] = values[places, column] == values[places + 1, column]
    return same


def _outliers(view: EpisodeView, name: str, entry: str, stream: Stream) -> Iterator[Issue]:
    """Single entries that leap off and back, unlike any other of the episode."""
    time, values = stream.time, stream.values.astype(np.float64)
    if len(time) < _FEWEST:
        return
    # Mirrored, so that the first and the last entry have neighbours.
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
    """Channels that are clipped at the end of their range that is farther from zero.

    A force rests near zero, at the other end. The channels of a profile share one converter, so one
    range.
    """
    names, low, high = sensor.channels.names, sensor.values.min(axis=0), sensor.values.max(axis=0)
    for group in group_channels(sensor.channels):
        for columns in [group.indices] if group.profile else [[c] for c in group.indices]:
            lower, upper = low[columns].min(), high[columns].max()
            end, which = (upper, "upper") if abs(upper) >= abs(lower) else (lower, "lower")
            if not (clipped := _clipped(sensor, columns, end)):
                continue
            places = np.flatnonzero((sensor.values[:, clipped] == end).any(axis=1))
            message = (
                f"{named(names, clipped)} ({len(clipped)} of {len(names)} channels) stand at the "
                f"{which} end of their range, {end:g}, in "
                f"{100 * len(places) / len(sensor.time):.1f} % of the readings"
            )
            yield view.issue("saturated", "sensor", message, *sensor.time[places[[0, -1]]].tolist())


def _clipped(sensor: Stream, columns: Sequence[int], end: np.floating) -> list[int]:
    """Those of these columns that stand at the end of their range, if enough are clipped there.

    A clipped channel has far more readings at the end than at the value next to it, some in a row.
    A channel of two values is a switch, and one that begins at its end rests there.
    """
    standing, clipped = list[int](), 0
    for column in columns:
        values = sensor.values[:, column]
        at_end = values == end
        if end == 0 or at_end.mean() < CLIPPED_SHARE or at_end.all():
            continue
        if len(columns) == 1 and at_end[sensor.time <= sensor.time[0] + REST_S].mean() >= 0.5:
            continue
        standing.append(column)
        others = values[~at_end]
        beside = np.count_nonzero(others == others[np.abs(others - end).argmin()])
        in_a_row = max(stop - start for start, stop in runs(at_end)) >= CLIPPED_RUN
        piled_up = np.count_nonzero(at_end) >= PILED_UP * beside
        clipped += bool(others.min() < others.max() and in_a_row and piled_up)
    return standing if clipped >= min(TOGETHER, len(columns)) else []


def statistics_blocks(view: EpisodeView, draw: Draw, params: Params) -> list[Block]:
    """A row a channel, a row for all channels of a profile; empty without any stream.

    The row of a profile has the extremes of all its channels, else the median over them.
    """
    rows: list[tuple[object, ...]] = []
    streams = view.shown
    for name, group in named_groups(streams):
        values = streams[name].values
        statistics = describe_channels(values, group.indices)
        if group.profile:
            joint = np.median(statistics, axis=0)
            joint[0], joint[4] = statistics[:, 0].min(), statistics[:, 4].max()
            names = [f"{group.names[0]} … {group.names[-1]} ({len(group.names):,} channels)"]
            statistics = joint[None]
        else:
            names = group.names
        for channel, row in zip(names, statistics.tolist(), strict=True):
            rows.append((name, channel, group.unit, len(values), *row))
    heads = ("stream", "channel", "unit", "count")
    heads += ("min", "1 %", "median", "99 %", "max", "mean", "std")
    caption = "Of many channels in a row: the extremes of all, else the median over the channels."
    return [Table(heads, rows, caption)] if rows else []


def describe_channels(values: NDArray[np.floating], columns: Sequence[int]) -> NDArray[np.float64]:
    """(column, 7) of values (reading, channel): min, 1 %, median, 99 %, max, mean, std."""
    parts: list[NDArray[np.float64]] = []
    for first in range(0, len(columns), _COLUMNS):
        block = values[:, columns[first : first + _COLUMNS]].astype(np.float64)
        points = np.percentile(block, (0, 1, 50, 99, 100), axis=0)
        parts.append(np.concatenate([points, [block.mean(axis=0), block.std(axis=0)]]).T)
    return np.concatenate(parts)
