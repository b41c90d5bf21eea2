"""The VL rows of a store in a plane: principal components of their features."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import eigsh

from pipeline.look.store.features import FeatureRows
from pipeline.store import FeatureStore, episode_name

_SMALL = 16
"""Rows up to which all directions are computed, as the iteration needs room."""
_TIE = 1e-3
"""Share by which coordinates count as equally large, so that rounding decides no sign."""


@dataclass(frozen=True, eq=False)
class StoreProjection:
    """VL rows as points of a plane, and what to colour them by."""

    points: NDArray[np.float64]
    """(row, 2) scores on the first two principal components, in the features' own unit."""
    explained: tuple[float, float]
    """Share of the variance that each axis holds."""
    rows: NDArray[np.int64]
    """(row,) store-global VL rows."""
    episode: NDArray[np.int64]
    """(row,) index into `episodes`."""
    progress: NDArray[np.float64]
    """(row,) 0 at the episode's first VL row, 1 at its last."""
    time: NDArray[np.float64]
    """(row,) s since the episode's first tick."""
    source: NDArray[np.int64]
    """(row,) index into `sources`."""
    episodes: tuple[str, ...]
    """`source/id` of every episode of the store."""
    sources: tuple[str, ...]
    total: int
    """VL rows of the store, of which `points` are evenly spread ones."""


def project(store: FeatureStore, found: FeatureRows) -> StoreProjection:
    """The two directions in which the features of all slots, side by side, vary most.

    Every slot less its mean, none scaled, invalid ones at their mean; from the dot products of the
    rows, whose eigenvectors are the left singular vectors of the features. The sign of an axis is
    such that the first of its largest coordinates is positive.
    """
    gram = found.gram.astype(np.float64)
    points, values = _main_axes(gram)
    whole = max(float(np.trace(gram)), np.finfo(np.float64).tiny)
    sampled = found.sampled
    return StoreProjection(
        points=points,
        explained=(float(values[0] / whole), float(values[1] / whole)),
        rows=sampled.rows,
        episode=sampled.episode,
        progress=sampled.progress,
        time=sampled.time,
        source=store.array("episode/source")[sampled.episode].astype(np.int64),
        episodes=tuple(episode_name(one) for one in store.episodes),
        sources=tuple(store.sources),
        total=sampled.total,
    )


def _main_axes(gram: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(row, 2) scores and (2,) squared singular values, the larger first."""
    count = len(gram)
    if not gram.any():
        return np.zeros((count, 2)), np.zeros(2)
    if count <= _SMALL:
        values, vectors = np.linalg.eigh(gram)
    else:
        start = np.random.default_rng(0).normal(size=count)  # else it draws one from the clock
        values, vectors = eigsh(gram, k=2, v0=start)
    order = np.argsort(values)[::-1][:2]
    values = np.maximum(values[order], 0)
    points = vectors[:, order] * np.sqrt(values)
    size = np.abs(points)
    far = (size >= (1 - _TIE) * size.max(axis=0)).argmax(axis=0)
    points *= np.where(points[far, np.arange(len(far))] < 0, -1, 1)
    pad = 2 - points.shape[1]
    return np.pad(points, ((0, 0), (0, pad))), np.pad(values, (0, pad))
