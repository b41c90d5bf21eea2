"""What looks wrong in the values: flat, still and frozen channels, actions and states
far beyond others."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from pipeline.base.channels import hardly_moving, named
from pipeline.data import Channels, Stream
from pipeline.look.recording.clocks import usual_step
from pipeline.look.recording.contact import force_columns
from pipeline.look.recording.facts import EpisodeView, Flaw
from pipeline.look.recording.runs import runs
from pipeline.look.recording.saturation import saturated

FROZEN_S = 0.5
"""A sensor whose channels all repeat for as long stands still."""
OUTLIER = 20.0
"""Times the 95th percentile of how far entries depart from their neighbours; and farther than all
others are apart."""

_FEWEST = 20
"""Entries below which nothing is said of a stream's values."""
_NEIGHBOURS = 5


def channel_flaws(view: EpisodeView) -> Iterator[Flaw]:
    """Flaws of kind flat channel, still channel, frozen, saturated, action and state outlier."""
    for name, stream in view.streams.items():
        if name != "poses" and len(stream.time) >= _FEWEST:
            yield from _flat(view, name, stream)
            if name != "sensor":  # the depths of a scan are not all equally bright
                yield from _still(view, name, stream)
    if view.sensor is not None and len(view.sensor.time) >= _FEWEST:
        yield from _frozen(view, view.sensor)
        yield from saturated(view, view.sensor)
    if (line := view.timeline) is not None:
        yield from _outliers(view, "action", "tick", line.action_channels, line.time, line.action)
    if (state := view.state) is not None:
        yield from _outliers(view, "state", "row", state.channels, state.time, state.values)


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
    span = float(stream.time[0]), float(stream.time[-1])
    yield view.flaw("flat channel", name, f"{said}; {others}", *span)


def _still(view: EpisodeView, name: str, stream: Stream) -> Iterator[Flaw]:
    if (still := still_channels(stream.channels, stream.values)) is not None:
        span = float(stream.time[0]), float(stream.time[-1])
        yield view.flaw("still channel", name, still[1], *span)


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
    what = "hardly moves" if len(columns) == 1 else "hardly move"
    return columns, (
        f"{named(names, columns)} {what}: a standard deviation of {std[largest]:.2g} at most, "
        f"where {usual[largest]:.2g} is usual for such channels; training scales every channel to "
        "unit spread, so that their noise would count like a motion"
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
    """(reading - 1,) whether a reading is that before, in these columns."""
    places = np.arange(len(values) - 1)
    for column in columns:
        places = places[values[places, column] == values[places + 1, column]]
    same = np.zeros(len(values) - 1, np.bool_)
    same[places] = True
    return same


def _outliers(
    view: EpisodeView,
    name: str,
    entry: str,
    channels: Channels,
    time: NDArray[np.float64],
    recorded: NDArray[np.float32],
) -> Iterator[Flaw]:
    """Single entries that leap off and back, unlike anything else in the episode."""
    if len(time) < _FEWEST:
        return
    values = recorded.astype(np.float64)
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
        said = f"{channels.names[column]} leaps to {values[worst, column]:.4g}"
        yield view.flaw(
            f"{name} outlier",
            name,
            f"{said} {channels.units[column]}".rstrip()
            + f" at {time[worst] - view.zero:.2f} s ({entry} {worst}; {len(places)} such {entry}s)"
            f"; all others stay within {others.min():.4g} to {others.max():.4g}",
            float(time[places[0]]),
            float(time[places[-1]]) + usual_step(time),
        )
