"""When everything was sampled: rates, jitter, gaps.

A step is a gap from `GAP_FACTOR` usual steps: one entry lost from a jittering clock (two steps and
the jitter) is none, two lost in a row are.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.look.recording.facts import Clock, ClockKind, EpisodeView, Gap

GAP_FACTOR = 2.5
"""Usual steps from which a step is a gap."""

_BURSTS = 0.5
"""Share of the mean step under which a median step means stamps in bursts."""
_LONGEST = 0.02
"""Share of the rising steps that may be gaps and are left out of the mean."""


def clocks(view: EpisodeView) -> tuple[Clock, ...]:
    """Every clock of the episode: cameras, streams, then ticks and VL rows.

    Poses that stand at the state's times have no clock of their own and are left out.
    """
    found = [_clock(name, "camera", camera.time) for name, camera in view.cameras.items()]
    for name, stream in view.streams.items():
        same = view.state is not None and np.array_equal(view.state.time, stream.time)
        if name != "poses" or not same:
            found.append(_clock(name, "stream", stream.time))
    if view.timeline is not None:
        found.append(_clock("ticks", "tick", view.timeline.time))
        found.append(_clock("VL rows", "vl_row", view.timeline.vl_time))
    return tuple(found)


def distinct_clocks(view: EpisodeView) -> Mapping[str, NDArray[np.float64]]:
    """The recorded clocks, those that are equal once, under all their names.

    So a gap in the rows of a LeRobot episode is one gap and not one of each view and stream.
    """
    names, times = list(view.clocks), list(view.clocks.values())
    return {", ".join(names[at] for at in same): times[same[0]] for same in equal_clocks(times)}


def equal_clocks(times: Sequence[NDArray[np.float64]]) -> list[list[int]]:
    """The places of clocks, those with the very same times together, in order of the first."""
    found: list[list[int]] = []
    for place, time in enumerate(times):
        same = next((one for one in found if np.array_equal(times[one[0]], time)), None)
        if same is None:
            found.append([place])
        else:
            same.append(place)
    return found


def usual_step(time: NDArray[np.float64]) -> float:
    """The step of a clock in seconds, NaN for fewer than two entries.

    The median; where entries are stamped in bursts, which have steps of nothing and long ones, the
    mean without the longest 2 % of the rising steps, which may be gaps; 0 where times only repeat.
    """
    return _usual(time)[0]


def gaps(time: NDArray[np.float64]) -> tuple[Gap, ...]:
    """Where a clock skips: steps of `shortest_gap` or more."""
    places = np.flatnonzero(np.diff(time) >= shortest_gap(time))
    return tuple(Gap(float(time[place]), float(time[place + 1])) for place in places)


def shortest_gap(time: NDArray[np.float64]) -> float:
    """Seconds from which a step of this clock is a gap: `GAP_FACTOR` usual steps.

    Between bursts, `GAP_FACTOR` times the steps that there are between bursts. Infinite for fewer
    than three entries, and where times only repeat: there no step is usual.
    """
    longest = _usual(time)[1]
    return GAP_FACTOR * longest if len(time) > 2 and longest > 0 else float("inf")


def _usual(time: NDArray[np.float64]) -> tuple[float, float]:
    """The usual step, and the longest that is usual."""
    steps = np.diff(time)
    if not len(steps):
        return float("nan"), float("nan")
    rising = np.sort(steps[steps > 0])
    if not len(rising):
        return 0.0, 0.0
    median = float(np.median(steps))
    kept = rising[: max(1, len(rising) - int(np.ceil(_LONGEST * len(rising))))]
    mean = float(kept.mean()) * len(rising) / len(steps)
    return (mean, float(kept[-1])) if median < _BURSTS * mean else (median, median)


def _clock(name: str, kind: ClockKind, time: NDArray[np.float64]) -> Clock:
    step, steps = usual_step(time), np.diff(time)
    small = steps[steps < shortest_gap(time)]
    return Clock(
        name=name,
        kind=kind,
        time=time,
        rate_hz=1 / step if step > 0 else float("nan"),
        jitter_s=float(small.std()) if len(small) > 1 else float("nan"),
        gaps=gaps(time),
    )
