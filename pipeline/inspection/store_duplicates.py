"""Which VL rows of a store say the same: still scenes, and recordings that are there twice."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pipeline.evaluation import episode_name
from pipeline.inspection.store_features import FeatureRows, SampledRows
from pipeline.store import KEY_BYTES, FeatureStore

_BLOCK_ROWS = 512
_LISTED = 50
"""Still stretches and pairs of episodes that are named; all are counted."""
_NO_DIRECTION = 1e-6
"""Of the root mean square norm: what lies nearer to the mean of all rows has no direction."""


@dataclass(frozen=True)
class Still:
    """Consecutive VL rows of an episode, each a near-duplicate of the one before."""

    episode: str
    start_s: float
    stop_s: float
    rows: int


@dataclass(frozen=True)
class Twins:
    """Two episodes that share what the model sees."""

    first: str
    second: str
    rows: tuple[int, int]
    """Rows of the first with a like in the second, and the other way round."""
    share: float
    """The larger of the two as a share of the rows of that episode that were looked at."""
    time_s: tuple[float, float]
    """When the most alike pair shows, in s since each episode's first tick."""
    similarity: float
    """Of that pair; 1 where they are equal."""


@dataclass(frozen=True, eq=False)
class Duplicates:
    """Near-duplicates by features, among the sampled rows, and equal inputs, among all rows."""

    threshold: float
    within: int
    """Sampled rows with a near-duplicate in their own episode."""
    across: int
    """Sampled rows with a near-duplicate in another episode."""
    still: tuple[Still, ...]
    """The longest first; at most 50."""
    still_count: int
    twins: tuple[Twins, ...]
    """By features, the largest share first; at most 50."""
    twins_count: int
    equal_rows: int
    """Rows of the whole store whose key another row has: same prompt, same pixels, same model."""
    equal_twins: tuple[Twins, ...]
    """Episodes that share keys; at most 50."""
    equal_twins_count: int
    episodes: NDArray[np.int64]
    """(episode,) indices of the episodes with sampled rows."""
    likeness: NDArray[np.float32]
    """(episode, episode) of these, the highest similarity between a row of one and a row of the
    other; NaN on the diagonal."""


def find_duplicates(store: FeatureStore, found: FeatureRows, threshold: float) -> Duplicates:
    """Rows whose features, less their mean over the rows, have a cosine >= `threshold`.

    All valid slots count, side by side. A row that is the mean itself has no direction and no like.
    """
    names = [episode_name(one) for one in store.episodes]
    sampled = found.sampled
    cosine = _Cosine(found.gram)
    episodes, starts = np.unique(sampled.episode, return_index=True)
    best = _best(cosine, starts)
    near = best >= threshold
    own = np.repeat(np.arange(len(episodes)), np.diff(starts, append=len(near)))
    in_own = near[np.arange(len(near)), own]
    near[np.arange(len(near)), own] = False
    still = list(_still(sampled, cosine, names, threshold))
    pairs = _pairs(near, starts)
    twins = [_twins(sampled, cosine, names, starts, *pair) for pair in pairs[:_LISTED]]
    equal, equal_twins = _equal(store, names)
    likeness = np.maximum.reduceat(best, starts, axis=0) if len(starts) else best
    np.fill_diagonal(likeness, np.nan)
    return Duplicates(
        threshold=threshold,
        within=int(in_own.sum()),
        across=int(near.any(axis=1).sum()),
        still=tuple(sorted(still, key=lambda one: -one.rows)[:_LISTED]),
        still_count=len(still),
        twins=tuple(twins),
        twins_count=len(pairs),
        equal_rows=equal,
        equal_twins=tuple(equal_twins[:_LISTED]),
        equal_twins_count=len(equal_twins),
        episodes=episodes,
        likeness=likeness,
    )


class _Cosine:
    """Cosines from dot products, block by block."""

    def __init__(self, gram: NDArray[np.float32]) -> None:
        self.gram = gram
        length = np.sqrt(np.maximum(np.diag(gram), 0, dtype=np.float64))
        least = _NO_DIRECTION * np.sqrt((length**2).mean()) if len(length) else 0
        self.scale = np.where(length > least, 1 / np.maximum(length, 1e-300), 0).astype(np.float32)

    def __call__(self, rows: slice, others: slice) -> NDArray[np.float32]:
        """(row, other)"""
        return self.gram[rows, others] * self.scale[rows, None] * self.scale[others]


def _best(cosine: _Cosine, starts: NDArray[np.int64]) -> NDArray[np.float32]:
    """(row, episode) the highest similarity to another row of each episode."""
    count = len(cosine.gram)
    best = np.full((count, len(starts)), -1, np.float32)
    for start in range(0, count, _BLOCK_ROWS):
        block = slice(start, min(start + _BLOCK_ROWS, count))
        similar = cosine(block, slice(None))
        similar[np.arange(len(similar)), np.arange(block.start, block.stop)] = -1
        best[block] = np.maximum.reduceat(similar, starts, axis=1)
    return best


def _still(
    sampled: SampledRows, cosine: _Cosine, names: list[str], threshold: float
) -> Iterator[Still]:
    """Runs of sampled rows, each like the one before it in the same episode."""
    before, after = np.arange(len(sampled.rows) - 1), np.arange(1, len(sampled.rows))
    similar = cosine.gram[before, after] * cosine.scale[before] * cosine.scale[after]
    same = sampled.episode[before] == sampled.episode[after]
    change = np.diff((same & (similar >= threshold)).astype(np.int8), prepend=0, append=0)
    for first, last in zip(np.flatnonzero(change > 0), np.flatnonzero(change < 0), strict=True):
        episode = names[int(sampled.episode[first])]
        times = float(sampled.time[first]), float(sampled.time[last])
        yield Still(episode, *times, int(last - first) + 1)


def _pairs(
    near: NDArray[np.bool_], starts: NDArray[np.int64]
) -> list[tuple[int, int, int, int, float]]:
    """Episodes a < b that share rows: (a, b, rows of a, rows of b, share), the largest first."""
    if not len(near):
        return []
    counts = np.add.reduceat(near, starts, axis=0, dtype=np.int64)
    rows = np.diff(starts, append=len(near))
    shares = counts / rows[:, None]
    found = [
        (
            int(a),
            int(b),
            int(counts[a, b]),
            int(counts[b, a]),
            float(max(shares[a, b], shares[b, a])),
        )
        for a, b in np.argwhere(np.triu(counts + counts.T, 1))
    ]
    return sorted(found, key=lambda one: -one[4])


def _twins(
    sampled: SampledRows,
    cosine: _Cosine,
    names: list[str],
    starts: NDArray[np.int64],
    a: int,
    b: int,
    of_a: int,
    of_b: int,
    share: float,
) -> Twins:
    edges = [*starts.tolist(), len(sampled.rows)]
    first, second = slice(edges[a], edges[a + 1]), slice(edges[b], edges[b + 1])
    similar = cosine(first, second)
    row, other = np.unravel_index(int(similar.argmax()), similar.shape)
    at = first.start + int(row), second.start + int(other)
    return Twins(
        names[int(sampled.episode[at[0]])],
        names[int(sampled.episode[at[1]])],
        (of_a, of_b),
        share,
        (float(sampled.time[at[0]]), float(sampled.time[at[1]])),
        min(1.0, float(similar[row, other])),
    )


def _equal(store: FeatureStore, names: list[str]) -> tuple[int, list[Twins]]:
    """Rows whose key another row of the store has, and the episodes that share keys."""
    keys = np.ascontiguousarray(store.array("vl/key")).view(f"V{KEY_BYTES}").ravel()
    _, number, counts = np.unique(keys, return_inverse=True, return_counts=True)
    shared = np.flatnonzero(counts[number] > 1)
    edges = store.array("episode/vl_start")
    episode = np.searchsorted(edges, shared, side="right") - 1
    of_key: dict[int, dict[int, list[int]]] = {}
    for row, key, owner in zip(
        shared.tolist(), number[shared].tolist(), episode.tolist(), strict=True
    ):
        of_key.setdefault(key, {}).setdefault(owner, []).append(row)
    rows: dict[tuple[int, int], list[list[int]]] = {}
    for owners in of_key.values():
        for a, b in combinations(owners, 2):
            pair = rows.setdefault((a, b), [[], []])
            pair[0] += owners[a]
            pair[1] += owners[b]
    lengths, time = np.diff(edges).tolist(), store.array("vl/time")
    found = [
        Twins(
            names[a],
            names[b],
            (len(of_a), len(of_b)),
            max(len(of_a) / lengths[a], len(of_b) / lengths[b]),
            (float(time[of_a[0]] - time[edges[a]]), float(time[of_b[0]] - time[edges[b]])),
            1.0,
        )
        for (a, b), (of_a, of_b) in rows.items()
    ]
    return len(shared), sorted(found, key=lambda one: -one.share)
