"""When a tool touches something, by the force alone.

At the start the needle is clear, so the median force of the first `_REST_S` is rest; the noise is
what the force does from reading to reading and within that time. The force, smoothed by a running
median, is in contact from where it leaves rest by `_ENTER` times its noise until it is back within
`_LEAVE` times: hysteresis, as in O. H. Schmitt, "A thermionic trigger", Journal of Scientific
Instruments 15(1), 1938. A force in newtons has to leave rest by `_LEAST_N` at least.

Its limits: a recording that begins in contact shows only what presses harder or less; a sensor that
drifts by more than the threshold makes a contact seem to begin early, or to last when the needle
has glided out of tissue; a touch below the threshold is none.
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
# Contacts nearer than this are one; shorter ones are none.
_APART_S, _SHORTEST_S = 0.1, 0.05

# The rule in a sentence, for a caption.
CONTACT_RULE = (
    f"It begins where the force leaves its median of the first {_REST_S:g} s by {_ENTER:g} times "
    f"its noise, and ends where it is back within {100 * _LEAVE / _ENTER:.0f} % of that."
)
# A standard deviation, of normal noise, that outliers do not raise.
_spread = partial(median_abs_deviation, axis=0, scale=1 / 1.4826)


def contact_spans(
    time: NDArray[np.float64], force: NDArray[Any], newton: bool, step_s: float
) -> list[tuple[float, float]]:
    """Start and stop in s of each contact; `force` is (reading, channel).

    Several channels (a wrench) count by the length of their departure from rest. `newton` says that
    all are in newtons, `step_s` is the usual step of `time`. None of fewer than three readings.
    """
    if len(time) < 3:
        return []
    force = force.astype(np.float64)
    resting = time <= time[0] + _REST_S
    # Where times only repeat there is no step, and nothing is smoothed.
    window = max(1, round(_SMOOTHED_S / (step_s or _SMOOTHED_S))) | 1
    smooth = median_filter(force, size=(window, 1), mode="nearest")
    rest = np.median(smooth[resting], axis=0)
    # Of the smoothed force, by the steps of the raw one, which hold no slow motion; and at rest.
    noise = _spread(np.diff(force, axis=0)) / np.sqrt(2 * window) + _spread(smooth[resting])
    departure = np.linalg.norm(smooth - rest, axis=1)
    enter = max(_ENTER * float(np.linalg.norm(noise)), _LEAST_N if newton else 0.0)
    away = (departure > enter * _LEAVE / _ENTER) & (departure > 0)
    edges = np.flatnonzero(np.diff(away, prepend=False, append=False)).reshape(-1, 2)
    spans: list[tuple[float, float]] = []
    for start, stop in edges.tolist():
        reached = np.flatnonzero(departure[start:stop] >= enter)
        if len(reached):
            # To the first reading after it, or the last.
            begin, end = float(time[start + reached[0]]), float(time[min(stop, len(time) - 1)])
            if spans and begin - spans[-1][1] < _APART_S:
                begin, _ = spans.pop()
            spans.append((begin, end))
    return [span for span in spans if span[1] - span[0] >= _SHORTEST_S]


def force_columns(names: Sequence[str]) -> list[int]:
    """The channels of a sensor whose names say force."""
    return [
        column
        for column, name in enumerate(names)
        if "force" in name.lower() or name.lower() in ("fx", "fy", "fz")
    ]
