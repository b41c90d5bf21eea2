"""Where the needle touches something, by the force alone.

The rule: at the start the needle is clear, so the median force of the first `_REST_S` is rest; the
noise is what the force does from reading to reading and within that time. The force, smoothed by a
running median, is in contact from where it leaves rest by `_ENTER` times its noise until it is back
within `_LEAVE` times: hysteresis, as in O. H. Schmitt, "A thermionic trigger", Journal of
Scientific Instruments 15(1), 1938. A force in newtons has to leave rest by `_LEAST_N` at least.

Its limits: a recording that begins in contact shows only what presses harder or less; a sensor that
drifts by more than the threshold makes a contact seem to begin early, or to last when the needle
has glided out of tissue; a touch below the threshold is none.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from pipeline.data import Stream
from pipeline.look.recording.clocks import usual_step
from pipeline.look.recording.episode import EpisodeView, runs

_REST_S = 0.5
_SMOOTHED_S = 0.02
_ENTER, _LEAVE = 6.0, 3.0
_LEAST_N = 0.05
# Contacts nearer than this are one; shorter ones are none.
_APART_S, _SHORTEST_S = 0.1, 0.05
# Of normal noise, standard deviation over median absolute deviation.
_MAD_TO_STD = 1.4826

# The rule in a sentence, for a caption.
RULE = (
    f"In contact: from where the force leaves its median of the first {_REST_S:g} s by "
    f"{_ENTER:g} times its noise (in newtons by {_LEAST_N:g} at least) until it is back within "
    f"{100 * _LEAVE / _ENTER:.0f} % of that."
)


class Contact(NamedTuple):
    """A span in which the needle touches something, by the force alone."""

    start_s: float
    stop_s: float


def contacts(view: EpisodeView) -> tuple[Contact, ...]:
    """Spans of contact, in order; none where there is no sensor or it has no force channel.

    Several force channels (a wrench) count by the length of their departure from rest.
    """
    if view.sensor is None:
        return ()
    columns = force_columns(view.sensor)
    if not columns or len(view.sensor.time) < 3:
        return ()
    time = view.sensor.time
    force = view.sensor.values[:, columns].astype(np.float64)
    resting = time <= time[0] + _REST_S
    # Where times only repeat there is no step, and nothing is smoothed.
    window = max(1, round(_SMOOTHED_S / (usual_step(time) or _SMOOTHED_S))) | 1
    smooth = median_filter(force, size=(window, 1), mode="nearest")
    rest = np.median(smooth[resting], axis=0)
    noise = _noise(force, window) + _mad(smooth[resting] - rest)
    least = _LEAST_N if {view.sensor.channels.units[column] for column in columns} == {"N"} else 0.0
    departure = np.linalg.norm(smooth - rest, axis=1)
    enter = max(_ENTER * float(np.linalg.norm(noise)), least)
    touching = _hysteresis(departure, enter, enter * _LEAVE / _ENTER)
    return _spans(time, touching)


def force_columns(sensor: Stream) -> list[int]:
    """The columns of a sensor whose names say force."""
    return [
        column
        for column, name in enumerate(sensor.channels.names)
        if "force" in name.lower() or name.lower() in ("fx", "fy", "fz")
    ]


def _noise(force: NDArray[np.float64], window: int) -> NDArray[np.float64]:
    """Of the smoothed force (channel,), by the steps of the raw one, which hold no slow motion."""
    return _mad(np.diff(force, axis=0)) / np.sqrt(2 * window)


def _mad(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return _MAD_TO_STD * np.median(np.abs(values - np.median(values, axis=0)), axis=0)


def _hysteresis(values: NDArray[np.float64], enter: float, leave: float) -> NDArray[np.bool_]:
    """From where values reach `enter` until they are no longer above `leave`, nor above 0."""
    kept = np.zeros(len(values), np.bool_)
    for start, stop in runs((values > leave) & (values > 0)):
        reached = np.flatnonzero(values[start:stop] >= enter)
        if len(reached):
            kept[start + reached[0] : stop] = True
    return kept


def _spans(time: NDArray[np.float64], touching: NDArray[np.bool_]) -> tuple[Contact, ...]:
    """Runs as spans: from the first reading in contact to the first after it, or the last."""
    spans: list[Contact] = []
    for start, stop in runs(touching):
        begin, end = float(time[start]), float(time[min(stop, len(time) - 1)])
        if spans and begin - spans[-1].stop_s < _APART_S:
            begin = spans.pop().start_s
        spans.append(Contact(begin, end))
    return tuple(span for span in spans if span.stop_s - span.start_s >= _SHORTEST_S)
