"""Long streams -> as many points as a picture has room for, without hiding an extreme or a gap."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.timeline import last_at

POINTS = 1200
"""Columns of a curve or an image; about the dots of a picture's width."""


@dataclass(frozen=True)
class Curve:
    """Points of curves: `time` (point,) s and `values` (point, channel), NaN where it breaks."""

    time: NDArray[np.float64]
    values: NDArray[np.float64]
    bin_s: float | None
    """Width of the bins of which each gives its least and greatest value; None where all stand."""


def usual_step(time: NDArray[np.float64]) -> float:
    """The median step of a clock in s; 0 for fewer than two entries."""
    return float(np.median(np.diff(time))) if len(time) > 1 else 0.0


def curve(time: NDArray[np.float64], values: NDArray[np.float32], points: int = POINTS) -> Curve:
    """All values (reading, channel), or the least and greatest of each of `points` bins in turn.

    Broken where the clock skips three usual steps or more.
    """
    longest = 3 * usual_step(time)
    if len(time) <= 4 * points:
        breaks = np.flatnonzero(np.diff(time) > longest) + 1 if longest else []
        shown = np.insert(values.astype(np.float64), breaks, np.nan, axis=0)
        return Curve(np.insert(time, breaks, time[breaks]), shown, None)
    edges = np.linspace(time[0], time[-1], points + 1)
    starts = np.searchsorted(time, edges[:-1])
    filled = np.diff(np.append(starts, len(time))) > 0
    starts = starts[filled]
    low, high = (which.reduceat(values, starts) for which in (np.minimum, np.maximum))
    extremes = np.stack([low, high], axis=1).reshape(2 * len(starts), -1)
    when = np.repeat((edges[:-1] + edges[1:])[filled] / 2, 2)
    breaks = np.flatnonzero(np.diff(when) > max(longest, 1.5 * (edges[1] - edges[0]))) + 1
    shown = np.insert(extremes.astype(np.float64), breaks, np.nan, axis=0)
    return Curve(np.insert(when, breaks, when[breaks]), shown, float(edges[1] - edges[0]))


def columns(
    time: NDArray[np.float64], values: NDArray[np.float32], count: int = POINTS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Edges (column + 1,) s and the means (channel, column) of the readings between them.

    A column without a reading shows the last one before it, and NaN where that is older than three
    usual steps: there the clock skips.
    """
    step = usual_step(time)
    edges = np.linspace(time[0], time[-1] + max(step, 1e-9), count + 1)
    starts = np.searchsorted(time, edges[:-1])
    filled = np.diff(np.append(starts, len(time))) > 0
    sums = np.add.reduceat(values, starts[filled], axis=0, dtype=np.float64)
    counts = np.diff(np.append(starts[filled], len(time)))
    shown = np.full((count, values.shape[1]), np.nan)
    shown[filled] = sums / counts[:, None]
    held = last_at(time, edges[:-1])
    age = edges[:-1] - time[np.maximum(held, 0)]
    hold = ~filled & (held >= 0) & (age <= max(3 * step, 0.0))
    shown[hold] = values[held[hold]]
    return edges, shown.T


def worst_steps(time: NDArray[np.float64], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """(bin,) s, the longest step of a clock that lies, if in part, between two edges.

    Infinite before the first entry and after the last.
    """
    steps = np.concatenate([[np.inf], np.diff(time), [np.inf]])
    first = np.searchsorted(time, edges[:-1], side="right")
    last = np.maximum(np.searchsorted(time, edges[1:], side="left"), first)
    return np.array([steps[a : b + 1].max() for a, b in zip(first, last, strict=True)])
