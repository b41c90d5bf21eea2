"""What looks wrong in the values: flat, still, frozen and clipped channels, actions far beyond
others."""

import re
from collections import defaultdict
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from pipeline.inspection.clocks import usual_step
from pipeline.inspection.contact import force_columns
from pipeline.inspection.facts import EpisodeView, Flaw
from pipeline.inspection.runs import runs
from pipeline.recordings import Stream

STILL = 0.01
"""Times the median standard deviation of the channels of its kind, below which one hardly moves."""
FROZEN_S = 0.5
"""A sensor whose channels all repeat for as long stands still."""
CLIPPED_SHARE, CLIPPED_RUN = 0.01, 5
"""Share of a channel's readings at the end of its range, and how many of them in a row."""
PILED_UP = 3
"""Times as many readings at the end of the range as at the value next to it."""
TOGETHER = 3
"""Channels of one converter that are clipped at least: what is bright enough for one is wide."""
OUTLIER = 20.0
"""Times the 95th percentile of how far actions depart from their neighbours; and farther than all
other actions are apart."""

_FEWEST = 20
"""Entries below which nothing is said of a stream's values."""
_WIDE = 8
"""Channels of one unit, from which their common largest value is taken for the end of the range."""
_ALIKE = 3
"""Moving channels of one kind, from which what is usual for them is known."""
_NEIGHBOURS = 5
_SHOWN = 4


def channel_flaws(view: EpisodeView) -> Iterator[Flaw]:
    """Flaws of kind flat channel, still channel, frozen, saturated and action outlier."""
    for name, stream in view.streams.items():
        if name != "poses" and len(stream.time) >= _FEWEST:
            yield from _flat(view, name, stream)
            if name != "sensor":  # the depths of a scan are not all equally bright
                yield from _still(view, name, stream)
    if view.sensor is not None and len(view.sensor.time) >= _FEWEST:
        yield from _frozen(view, view.sensor)
        yield from _saturated(view, view.sensor)
    yield from _outliers(view)


def named(names: Sequence[str], columns: Sequence[int]) -> str:
    """Channels by name, neighbours as one run: `aline_0003–aline_0007, aline_0100`."""
    places = np.asarray(columns, np.int64)
    groups = np.split(places, np.flatnonzero(np.diff(places) > 1) + 1)
    ends = [(names[int(group[0])], names[int(group[-1])]) for group in groups]
    said = [first if first == last else f"{first}–{last}" for first, last in ends]
    more = f" and {len(said) - _SHOWN} more" if len(said) > _SHOWN + 1 else ""
    return ", ".join(said[:_SHOWN] if more else said) + more


def _flat(view: EpisodeView, name: str, stream: Stream) -> Iterator[Flaw]:
    """Channels of one value; a gripper's is no flaw: many tasks never move it."""
    flat = stream.values.max(axis=0) == stream.values.min(axis=0)
    names = stream.channels.names
    columns = [c for c in np.flatnonzero(flat).tolist() if "gripper" not in names[c].lower()]
    if not columns:
        return
    if len(columns) == 1:
        said = f"{names[columns[0]]} is {stream.values[0, columns[0]]:g} throughout"
    else:
        said = f"{len(columns)} of {len(names)} channels never change: {named(names, columns)}"
    others = "no channel varies" if flat.all() else "the others vary"
    yield view.flaw("flat channel", name, f"{said}; {others}")


def _still(view: EpisodeView, name: str, stream: Stream) -> Iterator[Flaw]:
    """Channels that hardly move beside others of their kind, such as joints, and their unit."""
    names, units = stream.channels.names, stream.channels.units
    std = stream.values.std(axis=0, dtype=np.float64)
    kinds: dict[tuple[str, str], list[int]] = defaultdict(list)
    for column in np.flatnonzero(np.ptp(stream.values, axis=0) > 0).tolist():
        kinds[re.sub(r"\d+", "#", names[column]), units[column]].append(column)
    usual = {
        column: float(np.median(std[columns]))
        for columns in kinds.values()
        if len(columns) >= _ALIKE
        for column in columns
    }
    columns = sorted(column for column, each in usual.items() if std[column] < STILL * each)
    if not columns:
        return
    largest = max(columns, key=lambda column: std[column] / usual[column])
    what = "hardly moves" if len(columns) == 1 else "hardly move"
    yield view.flaw(
        "still channel",
        name,
        f"{named(names, columns)} {what}: a standard deviation of {std[largest]:.2g} at most, "
        f"where {usual[largest]:.2g} is usual for such channels; training scales every channel to "
        "unit spread, so that their noise would count like a motion",
    )


def _frozen(view: EpisodeView, sensor: Stream) -> Iterator[Flaw]:
    """Spans in which the whole sensor, or all of it but the force, repeats one reading."""
    force = force_columns(sensor)
    others = [column for column in range(sensor.values.shape[1]) if column not in force]
    if (sensor.values.max(axis=0) == sensor.values.min(axis=0))[others or force].all():
        return  # flat throughout, which is told already
    same = _repeats(sensor.values, others or force)
    for start, stop in runs(same):
        begin, end = float(sensor.time[start]), float(sensor.time[stop])
        if end - begin >= FROZEN_S:
            what = "all channels but the force" if force and others else "all channels"
            yield view.flaw(
                "frozen",
                "sensor",
                f"{what} repeat one reading for {end - begin:.2f} s from {begin - view.zero:.2f} s "
                f"({stop - start + 1} readings); elsewhere they change",
                begin,
                end,
            )


def _repeats(values: NDArray[np.float32], columns: Sequence[int]) -> NDArray[np.bool_]:
    """(reading - 1,) whether a reading is that before; row by row only where one column agrees."""
    first = values[:, columns[0]]
    same = first[1:] == first[:-1]
    places = np.flatnonzero(same)
    for place in places:
        same[place] = np.array_equal(values[place, columns], values[place + 1, columns])
    return same


def _saturated(view: EpisodeView, sensor: Stream) -> Iterator[Flaw]:
    """Channels that are clipped, in one line for each end of the range."""
    values, wide = sensor.values, _wide_columns(sensor)
    largest, smallest = values.max(axis=0), values.min(axis=0)
    for end, own in (("upper", largest), ("lower", smallest)):
        reached = own.copy()
        # Channels of one converter end at one value.
        if wide:
            reached[wide] = own[wide].max() if end == "upper" else own[wide].min()
        candidates = np.flatnonzero((own == reached) & (own != 0) & (largest > smallest))
        clipped = [
            (column, at_end)
            for column in candidates.tolist()
            if (at_end := _clipped(values[:, column], own[column])) is not None
        ]
        if sum(column in wide for column, _ in clipped) < TOGETHER:
            clipped = [one for one in clipped if one[0] not in wide]
        if clipped:
            yield _clipped_flaw(view, sensor, end, clipped)


def _clipped(values: NDArray[np.float32], end: np.float32) -> NDArray[np.bool_] | None:
    """Where a channel stands at an end of its range; None where that is no clipping.

    A channel that rests at its end, as a force does at zero load, is not clipped there.
    """
    at_end = values == end
    away = abs(float(end) - float(np.median(values))) > 0.2 * float(np.ptp(values))
    if not away or at_end.mean() < CLIPPED_SHARE or not _piled_up(values, at_end):
        return None
    plateaus = [start for start, stop in runs(at_end) if stop - start >= CLIPPED_RUN]
    return at_end if plateaus else None


def _clipped_flaw(
    view: EpisodeView, sensor: Stream, end: str, clipped: Sequence[tuple[int, NDArray[np.bool_]]]
) -> Flaw:
    columns = [column for column, _ in clipped]
    anywhere = np.logical_or.reduce([at_end for _, at_end in clipped])
    places = np.flatnonzero(anywhere)
    start, stop = float(sensor.time[places[0]]), float(sensor.time[places[-1]])
    names = sensor.channels.names
    value = sensor.values[places[0], next(column for column, at in clipped if at[places[0]])]
    return view.flaw(
        "saturated",
        "sensor",
        f"{named(names, columns)} ({len(columns)} of {len(names)} channels) stand at the {end} end "
        f"of their range, {value:g}, in {100 * anywhere.mean():.1f} % of the readings, first at "
        f"{start - view.zero:.2f} s; expected under {100 * CLIPPED_SHARE:g} %",
        start,
        stop,
    )


def _piled_up(values: NDArray[np.float32], at_end: NDArray[np.bool_]) -> bool:
    """Whether far more readings stand at the end than at the value next to it, as clipping does."""
    end = values[np.argmax(at_end)]
    others = values[~at_end]
    beside = others[np.argmin(np.abs(others - end))]
    return bool(np.count_nonzero(at_end) >= PILED_UP * np.count_nonzero(others == beside))


def _wide_columns(sensor: Stream) -> list[int]:
    force = set(force_columns(sensor))
    columns = [c for c in range(len(sensor.channels.names)) if c not in force]
    one_unit = len({sensor.channels.units[column] for column in columns}) == 1
    return columns if one_unit and len(columns) >= _WIDE else []


def _outliers(view: EpisodeView) -> Iterator[Flaw]:
    """Single ticks whose action leaps off and back, unlike anything else in the episode."""
    line = view.timeline
    if line is None or len(line.time) < _FEWEST:
        return
    action = line.action.astype(np.float64)
    away = np.abs(action - median_filter(action, size=(_NEIGHBOURS, 1), mode="nearest"))
    usual = np.percentile(away, 95, axis=0)
    names, units = line.action_channels.names, line.action_channels.units
    for column in np.flatnonzero(usual > 0).tolist():
        ticks = np.flatnonzero(away[:, column] > OUTLIER * usual[column])
        others = np.delete(action[:, column], ticks)
        ticks = ticks[away[ticks, column] > np.ptp(others)]
        if not len(ticks):
            continue
        worst = int(ticks[np.argmax(away[ticks, column])])
        begin, stop = float(line.time[ticks[0]]), float(line.time[ticks[-1]])
        yield view.flaw(
            "action outlier",
            "action",
            f"{names[column]} leaps to {action[worst, column]:.4g} {units[column]}".rstrip()
            + f" at {line.time[worst] - view.zero:.2f} s (tick {worst}; {len(ticks)} such ticks); "
            f"all others stay within {others.min():.4g} to {others.max():.4g}",
            begin,
            stop + usual_step(line.time),
        )
