"""Which VL rows of a store say the same: still scenes, and recordings that are there twice."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.look.recording.episode import runs
from pipeline.look.store.features import FeatureRows, SampledRows
from pipeline.store import KEY_BYTES, FeatureStore, episode_name

_BLOCK_ROWS = 512
_LISTED = 50
"""Still stretches and pairs of episodes that are named; all are counted."""
_ROUNDING = 1e-6
"""Of a cosine in float32: rows that are equal may come out this much below 1."""
_NO_DIRECTION = 1e-6
"""Of the root mean square norm: what lies nearer to the mean of all rows has no direction."""


@dataclass(frozen=True)
class Still:
    """Sampled rows of an episode, one after the other, each a near-duplicate of the one before."""

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
    """Episodes that share keys: the first that has one and each other; at most 50."""
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
    near = best >= threshold - _ROUNDING
    own = np.repeat(np.arange(len(episodes)), np.diff(starts, append=len(near)))
    in_own = near[np.arange(len(near)), own]
    near[np.arange(len(near)), own] = False
    still = sorted(_still(sampled, cosine, names, threshold), key=lambda one: -one.rows)
    twins, twins_count = _twins(sampled, cosine, names, starts, near)
    equal, equal_twins = _equal(store, names)
    likeness = np.maximum.reduceat(best, starts, axis=0) if len(starts) else best
    np.fill_diagonal(likeness, np.nan)
    return Duplicates(
        threshold=threshold,
        within=int(in_own.sum()),
        across=int(near.any(axis=1).sum()),
        still=tuple(still[:_LISTED]),
        still_count=len(still),
        twins=twins,
        twins_count=twins_count,
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
    for first, last in runs(same & (similar >= threshold - _ROUNDING)):
        episode = names[int(sampled.episode[first])]
        times = float(sampled.time[first]), float(sampled.time[last])
        yield Still(episode, *times, last - first + 1)


def _twins(
    sampled: SampledRows,
    cosine: _Cosine,
    names: list[str],
    starts: NDArray[np.int64],
    near: NDArray[np.bool_],
) -> tuple[tuple[Twins, ...], int]:
    """Episodes that share rows by features: those that share most of theirs, and how many."""
    stops = np.append(starts[1:], len(near))
    counts = np.add.reduceat(near, starts, axis=0, dtype=np.int32)
    shares = (counts / (stops - starts)[:, None]).astype(np.float32)
    shares = np.triu(np.maximum(shares, shares.T), 1)
    found = int(np.count_nonzero(shares))
    largest = np.argsort(-shares, axis=None, kind="stable")[: min(found, _LISTED)]
    twins: list[Twins] = []
    for a, b in zip(*np.unravel_index(largest, shares.shape), strict=True):
        similar = cosine(slice(starts[a], stops[a]), slice(starts[b], stops[b]))
        row, other = np.unravel_index(int(similar.argmax()), similar.shape)
        at = [starts[a] + row, starts[b] + other]
        first, second = sampled.episode[at].tolist()
        of_a, of_b = int(counts[a, b]), int(counts[b, a])
        begin, other_begin = sampled.time[at].tolist()
        likeness = min(1.0, float(similar[row, other]))
        twins.append(
            Twins(
                names[first],
                names[second],
                (of_a, of_b),
                float(shares[a, b]),
                (begin, other_begin),
                likeness,
            )
        )
    return tuple(twins), found


def _equal(store: FeatureStore, names: list[str]) -> tuple[int, list[Twins]]:
    """Rows whose key another row of the store has, and the episodes that share keys."""
    keys = np.ascontiguousarray(store.array("vl/key")).view(f"V{KEY_BYTES}").ravel()
    edges, time = store.array("episode/vl_start"), store.array("vl/time")
    _, key, counts = np.unique(keys, return_inverse=True, return_counts=True)
    owner = np.repeat(np.arange(len(names)), np.diff(edges))
    first = np.full(len(counts), len(names))
    np.minimum.at(first, key, owner)
    later = first[key] < owner
    found: list[Twins] = []
    for a, b in np.unique(np.column_stack([first[key], owner])[later], axis=0).tolist():
        of_a, of_b = key[edges[a] : edges[a + 1]], key[edges[b] : edges[b + 1]]
        shared = np.flatnonzero(np.isin(of_a, of_b)), np.flatnonzero(np.isin(of_b, of_a))
        rows = len(shared[0]), len(shared[1])
        share = max(rows[0] / len(of_a), rows[1] / len(of_b))
        other = int((of_b == of_a[shared[0][0]]).argmax())
        at = np.array([edges[a] + shared[0][0], edges[b] + other])
        begin, other_begin = (time[at] - time[edges[[a, b]]]).tolist()
        found.append(Twins(names[a], names[b], rows, share, (begin, other_begin), 1.0))
    return int((counts[key] > 1).sum()), sorted(found, key=lambda one: -one.share)
