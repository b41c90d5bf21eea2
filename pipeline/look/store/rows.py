"""What the VL rows of a store are: how old where ticks use them, and which are there twice."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.base.issue import Issue
from pipeline.base.table import Table
from pipeline.data.timeline import COARSEST_S
from pipeline.look.page.blocks import Block, Text
from pipeline.look.store.episodes import EpisodeCoverage
from pipeline.store import KEY_BYTES, FeatureStore

_STALE_PERIODS = 2
_SAME_SHARE = 0.5
"""Of an episode's rows, from which it says little that the other does not."""


@dataclass(frozen=True, eq=False)
class Ages:
    """How old the features are at each tick: time of the tick less capture time of the frame."""

    newest: NDArray[np.float32]
    """(tick,) s since the newest frame, as `FeatureStore.feature_age` says."""
    by_view: Mapping[str, NDArray[np.float32]]
    """(tick,) s since the frame of each view; NaN where the view is missing."""
    period_s: float
    """Time from one VL row to the next: `vlm_reuse_count` median steps of the ticks; NaN where no
    episode has two ticks."""


def read_ages(store: FeatureStore) -> Ages:
    """Read the times of all ticks; neither features nor readings are read."""
    shown = store.array("vl/frame_time")[store.array("tick/vl_row")]
    ages = (store.array("tick/time")[:, None] - shown).astype(np.float32)
    by_view = dict(zip(store.streams["views"], ages.T, strict=True))
    newest = store.feature_age(np.arange(store.ticks)).astype(np.float32)
    return Ages(newest, by_view, store.vlm_reuse_count * store.tick_step())


def show_ages(ages: Ages) -> list[Block]:
    """What an age is, and its spread for each view."""
    rows = [
        (name, *np.nanquantile(age, (0.01, 0.5, 0.99, 1.0)).tolist())
        for name, age in {"newest frame": ages.newest, **ages.by_view}.items()
        if np.isfinite(age).any()
    ]
    return [
        Text("The policy is given the age of the newest frame as `feature_age`."),
        Table(("age [s] of", "1 %", "median", "99 %", "oldest"), rows),
    ]


def find_age_issues(
    store: FeatureStore, episodes: Sequence[EpisodeCoverage], ages: Ages
) -> Iterator[Issue]:
    """Frames from the future, and features far older than their VL row serves, by episode."""
    limit = _STALE_PERIODS * ages.period_s
    for episode in episodes:
        time, age = store.array("tick/time")[episode.ticks], ages.newest[episode.ticks]
        ahead, old = np.flatnonzero(age < -COARSEST_S), np.flatnonzero(age > limit)
        if len(ahead):
            text = f"{len(ahead)} ticks see a frame taken after them, by up to {-age.min():.3f} s"
            span = time[ahead[[0, -1]]] - time[0]
            kind = "frames from the future"
            yield episode.issue(kind, "vl/frame_time", text, *span, severity="error")
        if len(old):
            text = f"{len(old)} of {len(age)} ticks see features up to {age.max():.2f} s old, over "
            text += f"{limit:.2f} s, the time of {_STALE_PERIODS} VL rows"
            span = time[old[[0, -1]]] - time[0]
            yield episode.issue("old frames", "vl/frame_time", text, *span)


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
    time_s: float
    """When the first of them shows, in s since the first tick of the first episode."""


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
        of_both, in_a, _ = np.intersect1d(of_a, of_b, return_indices=True)
        rows = int(np.isin(of_a, of_both).sum()), int(np.isin(of_b, of_both).sum())
        share = max(rows[0] / len(of_a), rows[1] / len(of_b))
        shown = float(time[edges[a] + in_a.min()] - time[edges[a]])
        pairs.append(EpisodePair(a, b, rows, share, shown))
    pairs.sort(key=lambda pair: -pair.share)
    return Duplicates(len(keys), int((counts[key] > 1).sum()), tuple(pairs))


def show_duplicates(found: Duplicates) -> list[Block]:
    """How many rows there are twice; the findings say in which episodes."""
    twice = f"{found.rows:,} of {found.total:,} VL rows, in {len(found.pairs):,} pair(s)"
    return [Text(f"{twice} of episodes, have exactly the frames and prompt of another row.")]


def find_duplicate_issues(
    duplicates: Duplicates, episodes: Sequence[EpisodeCoverage]
) -> Iterator[Issue]:
    """Pairs of episodes of which one says little that the other does not."""
    for pair in duplicates.pairs:
        if pair.share >= _SAME_SHARE:
            text = f"{pair.rows[0]} of its VL rows have the very frames and prompt of "
            text += f"{pair.rows[1]} rows of {episodes[pair.second].name}"
            issue = episodes[pair.first].issue("same recording", "vl/key", text)
            yield replace(issue, start_s=pair.time_s)
