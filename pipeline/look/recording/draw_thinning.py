"""Long streams -> as many points as a picture has room for, without hiding an extreme or a gap."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipeline.data.timeline import last_at
from pipeline.look.recording.clocks import GAP_FACTOR, shortest_gap, usual_step

POINTS = 1200
"""Columns of a curve or an image; about the dots of a picture's width."""
_LEAST_S = 1e-3
"""Seconds that an image covers at least."""


@dataclass(frozen=True)
class Curve:
    """Points of curves: `time` (point,) s and `values` (point, channel), NaN where it breaks."""

    time: NDArray[np.float64]
    values: NDArray[np.float64]
    bin_s: float | None
    """Width of the bins of which each gives its least and greatest value; None where all stand."""


def curve(time: NDArray[np.float64], values: NDArray[np.float32], points: int = POINTS) -> Curve:
    """All values (reading, channel), or the least and greatest of each of `points` bins in turn.

    Broken where the clock has a gap.
    """
    gap = shortest_gap(time)
    if len(time) <= 4 * points:
        breaks = np.flatnonzero(np.diff(time) >= gap) + 1
        shown = np.insert(values.astype(np.float64), breaks, np.nan, axis=0)
        return Curve(np.insert(time, breaks, time[breaks]), shown, None)
    edges = np.linspace(time[0], time[-1], points + 1)
    starts = np.searchsorted(time, edges[:-1])
    filled = np.diff(np.append(starts, len(time))) > 0
    starts = starts[filled]
    low, high = (which.reduceat(values, starts) for which in (np.minimum, np.maximum))
    extremes = np.stack([low, high], axis=1).reshape(2 * len(starts), -1)
    when = np.repeat((edges[:-1] + edges[1:])[filled] / 2, 2)
    breaks = np.flatnonzero(np.diff(when) > max(gap, 1.5 * (edges[1] - edges[0]))) + 1
    shown = np.insert(extremes.astype(np.float64), breaks, np.nan, axis=0)
    return Curve(np.insert(when, breaks, when[breaks]), shown, float(edges[1] - edges[0]))


def columns(
    time: NDArray[np.float64], values: NDArray[np.float32], count: int = POINTS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Edges (column + 1,) s and the means (channel, column) of the readings between them.

    A column without a reading shows the last one before it, and NaN where that is so old that the
    clock has a gap there.
    """
    gap = shortest_gap(time)
    # A single reading too is as wide as a time of day can tell.
    stop = max(time[-1] + np.nan_to_num(usual_step(time)), time[0] + _LEAST_S)
    edges = np.linspace(time[0], stop, count + 1)
    bounds = np.append(np.searchsorted(time, edges[:-1]), len(time))
    held = last_at(time, edges[:-1])
    shown = np.full((count, values.shape[1]), np.nan)
    # `np.add.reduceat` along rows takes forty times as long.
    for column, (first, stop) in enumerate(pairwise(bounds.tolist())):
        if stop > first:
            shown[column] = values[first:stop].mean(axis=0, dtype=np.float64)
        elif edges[column] - time[held[column]] < gap:
            shown[column] = values[held[column]]
    return edges, shown.T


def evenness(time: NDArray[np.float64], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """(bin,) from 0 to 1: the longest step that is usual over the longest one between two edges.

    1 where no entry is lost, also of a clock in bursts; 0 before the first entry, after the last.
    """
    longest = worst_steps(time, edges)
    known = np.isfinite(longest)
    usual = shortest_gap(time) / GAP_FACTOR
    shares = np.zeros(len(longest))
    shares[known] = np.minimum(usual / np.maximum(longest[known], 1e-12), 1.0)
    return shares


def worst_steps(time: NDArray[np.float64], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """(bin,) s, the longest step of a clock that lies, if in part, between two edges.

    Infinite before the first entry and after the last.
    """
    steps = np.concatenate([[np.inf], np.diff(time), [np.inf]])
    first = np.searchsorted(time, edges[:-1], side="right")
    last = np.maximum(np.searchsorted(time, edges[1:], side="left"), first)
    return np.array([steps[a : b + 1].max() for a, b in zip(first, last, strict=True)])
