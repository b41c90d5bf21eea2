"""Readings that are clipped at an end of their range."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.base.channels import named
from pipeline.data import Stream
from pipeline.look.recording.contact import force_columns
from pipeline.look.recording.facts import EpisodeView, Flaw
from pipeline.look.recording.runs import runs

CLIPPED_SHARE, CLIPPED_RUN = 0.01, 5
"""Share of a channel's readings at the end of its range, and how many of them in a row."""
PILED_UP = 3
"""Times as many readings at the end of the range as at the value next to it."""
TOGETHER = 3
"""Channels of one converter that are clipped at least: what is bright enough for one is wide."""
REST_S, AT_REST = 0.5, 0.2
"""For as long at the start a channel may rest at its end; share of the range that is near it."""
_WIDE = 8
"""Channels of one unit, from which their common largest value is taken for the end of the range."""


def saturated(view: EpisodeView, sensor: Stream) -> Iterator[Flaw]:
    """Channels that are clipped, in one line for each end of the range."""
    values, wide = sensor.values, _wide_columns(sensor)
    largest, smallest = values.max(axis=0), values.min(axis=0)
    for end, own in (("upper", largest), ("lower", smallest)):
        reached = own.copy()
        # Channels of one converter end at one value.
        if wide:
            reached[wide] = own[wide].max() if end == "upper" else own[wide].min()
        standing = [
            column
            for column in np.flatnonzero(
                (own == reached) & (own != 0) & (largest > smallest)
            ).tolist()
            if (values[:, column] == own[column]).mean() >= CLIPPED_SHARE
            # What many depths reach together at most is no rest, however long one stands there.
            and ((end == "upper" and column in wide) or not _rests(sensor, column, own[column]))
        ]
        clipped = [column for column in standing if _clipped(values[:, column], own[column])]
        together = sum(column in wide for column in clipped) >= TOGETHER
        columns = [c for c in standing if (together if c in wide else c in clipped)]
        if columns:
            yield _clipped_flaw(view, sensor, end, columns, own)


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
    """Whether a channel that reaches this end is cut off there, in some readings in a row."""
    at_end = values == end
    plateaus = (stop - start for start, stop in runs(at_end))
    return _piled_up(values, at_end) and max(plateaus) >= CLIPPED_RUN


def _clipped_flaw(
    view: EpisodeView, sensor: Stream, end: str, columns: Sequence[int], own: NDArray[np.float32]
) -> Flaw:
    anywhere = np.zeros(len(sensor.time), np.bool_)
    for column in columns:
        anywhere |= sensor.values[:, column] == own[column]
    places = np.flatnonzero(anywhere)
    start, stop = float(sensor.time[places[0]]), float(sensor.time[places[-1]])
    names = sensor.channels.names
    value = next(own[c] for c in columns if sensor.values[places[0], c] == own[c])
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
    """Whether far more readings stand at the end than at the value next to it, as clipping does.

    A channel of two values is a switch, which has no value next to its end.
    """
    end = values[np.argmax(at_end)]
    others = values[~at_end]
    if others.min() == others.max():
        return False
    beside = others[np.argmin(np.abs(others - end))]
    return bool(np.count_nonzero(at_end) >= PILED_UP * np.count_nonzero(others == beside))


def _wide_columns(sensor: Stream) -> list[int]:
    force = set(force_columns(sensor))
    columns = [c for c in range(len(sensor.channels.names)) if c not in force]
    one_unit = len({sensor.channels.units[column] for column in columns}) == 1
    return columns if one_unit and len(columns) >= _WIDE else []
