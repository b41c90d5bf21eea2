"""Finds when a tool touches something, from the force alone.

The needle touches nothing at the start, so the median force of the first `_REST_S` is rest. The
noise is the spread of the force from reading to reading plus its spread during that time. The
force, smoothed by a running median, is in contact from the time it leaves rest by `_ENTER` times
its noise until it is back within `_LEAVE` times: hysteresis, as in O. H. Schmitt, "A thermionic
trigger", Journal of Scientific Instruments 15(1), 1938. A force in newtons must leave rest by at
least `_LEAST_N`.

Limits: in a recording that begins in contact, only a stronger or weaker force is found. If the
sensor drifts by more than the threshold, a contact seems to begin early, or to last after the
needle has left the tissue. A touch below the threshold is not found.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.stats import median_abs_deviation

_REST_S = 0.5
_SMOOTHED_S = 0.02
_ENTER, _LEAVE = 6.0, 3.0
_LEAST_N = 0.05
# Contacts nearer than the first are joined; those shorter than the second are dropped.
_APART_S, _SHORTEST_S = 0.1, 0.05

# The rule in one sentence, for a caption.
CONTACT_RULE = (
    f"It begins where the force leaves its median of the first {_REST_S:g} s by {_ENTER:g} times "
    f"its noise, and ends where it is back within {100 * _LEAVE / _ENTER:.0f} % of that."
)
# An estimate of the standard deviation of normal noise that is robust to outliers.
_spread = partial(median_abs_deviation, axis=0, scale=1 / 1.4826)


def contact_spans(
    time: NDArray[np.float64], force: NDArray[Any], newton: bool, step_s: float
) -> list[tuple[float, float]]:
    """Start and stop in s of each contact; `force` is (reading, channel).

    For several channels (a wrench), the norm of the difference from rest counts. `newton` says that
    all channels are in newtons; `step_s` is the usual step of `time`. Empty for fewer than three
    readings.
    """
    if len(time) < 3:
        return []
    force = force.astype(np.float64)
    resting = time <= time[0] + _REST_S
    # Where all times are equal there is no step, and nothing is smoothed.
    window = max(1, round(_SMOOTHED_S / (step_s or _SMOOTHED_S))) | 1
    smooth = median_filter(force, size=(window, 1), mode="nearest")
    rest = np.median(smooth[resting], axis=0)
    # Noise of the smoothed force, from the steps of the raw force (free of slow motion) and at
    # rest.
    noise = _spread(np.diff(force, axis=0)) / np.sqrt(2 * window) + _spread(smooth[resting])
    departure = np.linalg.norm(smooth - rest, axis=1)
    enter = max(_ENTER * float(np.linalg.norm(noise)), _LEAST_N if newton else 0.0)
    away = (departure > enter * _LEAVE / _ENTER) & (departure > 0)
    edges = np.flatnonzero(np.diff(away, prepend=False, append=False)).reshape(-1, 2)
    spans: list[tuple[float, float]] = []
    for start, stop in edges.tolist():
        reached = np.flatnonzero(departure[start:stop] >= enter)
        if len(reached):
            # The span ends at the first reading after it, or at the last reading.
            begin, end = float(time[start + reached[0]]), float(time[min(stop, len(time) - 1)])
            if spans and begin - spans[-1][1] < _APART_S:
                begin, _ = spans.pop()
            spans.append((begin, end))
    return [span for span in spans if span[1] - span[0] >= _SHORTEST_S]


def force_columns(names: Sequence[str]) -> list[int]:
    """The columns of the sensor channels whose names mean a force."""
    return [
        column
        for column, name in enumerate(names)
        if "force" in name.lower() or name.lower() in ("fx", "fy", "fz")
    ]
