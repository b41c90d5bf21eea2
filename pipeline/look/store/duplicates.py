"""Which VL rows of a store have equal keys: recordings that are there twice."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.base.issue import Issue
from pipeline.base.table import Table
from pipeline.look.page.blocks import Block, Text
from pipeline.look.store.episodes import EpisodeCoverage
from pipeline.store import KEY_BYTES, FeatureStore

_LISTED = 50
"""Pairs of episodes in the table; all are counted."""
_SAME_SHARE = 0.5
"""Of an episode's rows, from which it says little that the other does not."""


@dataclass(frozen=True)
class EpisodePair:
    """Two episodes with rows of the same prompt, pixels and feature spec."""

    first: int
    second: int
    """Indices of the episodes."""
    rows: tuple[int, int]
    """Rows of the first whose key the second has, and the other way round."""
    share: float
    """The larger of the two as a share of the rows of that episode."""
    time_s: tuple[float, float]
    """When the first of them shows, in s since each episode's first tick."""


@dataclass(frozen=True)
class Duplicates:
    """Equal keys among all rows of a store."""

    total: int
    """VL rows of the store."""
    rows: int
    """Of these, rows whose key another row has."""
    pairs: tuple[EpisodePair, ...]
    """The first episode that has a key and each other, the largest share first."""


def find_duplicates(store: FeatureStore) -> Duplicates:
    """Compare the keys of all rows, whatever their features."""
    keys = np.ascontiguousarray(store.array("vl/key")).view(f"V{KEY_BYTES}").ravel()
    edges, time = store.array("episode/vl_start"), store.array("vl/time")
    _, key, counts = np.unique(keys, return_inverse=True, return_counts=True)
    owner = np.repeat(np.arange(len(edges) - 1), np.diff(edges))
    first = np.full(len(counts), len(edges))
    np.minimum.at(first, key, owner)
    later = first[key] < owner
    pairs: list[EpisodePair] = []
    for a, b in np.unique(np.column_stack([first[key], owner])[later], axis=0).tolist():
        of_a, of_b = key[edges[a] : edges[a + 1]], key[edges[b] : edges[b + 1]]
        of_both, in_a, in_b = np.intersect1d(of_a, of_b, return_indices=True)
        rows = int(np.isin(of_a, of_both).sum()), int(np.isin(of_b, of_both).sum())
        share = max(rows[0] / len(of_a), rows[1] / len(of_b))
        at = in_a.argmin()
        shown = time[[edges[a] + in_a[at], edges[b] + in_b[at]]] - time[edges[[a, b]]]
        pairs.append(EpisodePair(a, b, rows, share, tuple(shown.tolist())))
    pairs.sort(key=lambda pair: -pair.share)
    return Duplicates(len(keys), int((counts[key] > 1).sum()), tuple(pairs))


def show_duplicates(duplicates: Duplicates, episodes: Sequence[EpisodeCoverage]) -> list[Block]:
    """How many rows there are twice, and in which episodes."""
    pairs = duplicates.pairs
    text = Text(
        f"By their keys, {duplicates.rows:,} of {duplicates.total:,} VL rows have exactly the "
        f"frames and prompt of another row; pairs of episodes with such rows: {len(pairs):,}."
    )
    rows: list[tuple[object, ...]] = []
    for pair in pairs[:_LISTED]:
        first, second = (episodes[index].name for index in (pair.first, pair.second))
        rows.append((first, pair.rows[0], pair.time_s[0], second, pair.rows[1], pair.time_s[1]))
    heads = ("episode", "rows", "at [s]", "other episode", "rows ", "at [s] ")
    table = Table(heads, rows, f"Rows with equal keys, {_LISTED} pairs of episodes at most.")
    return [text, table] if pairs else [text]


def find_duplicate_issues(
    duplicates: Duplicates, episodes: Sequence[EpisodeCoverage]
) -> Iterator[Issue]:
    """Pairs of episodes of which one says little that the other does not."""
    for pair in duplicates.pairs:
        if pair.share >= _SAME_SHARE:
            text = f"{pair.rows[0]} of its VL rows have the very frames and prompt of "
            text += f"{pair.rows[1]} rows of {episodes[pair.second].name}"
            issue = episodes[pair.first].issue("same recording", "vl/key", text)
            yield replace(issue, start_s=pair.time_s[0])
