"""What looks wrong in the features of a store: dead slots, odd lengths, recordings twice."""

from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from pipeline.base.issue import Issue as Flaw
from pipeline.look.store.coverage import EpisodeCoverage
from pipeline.look.store.duplicates import Duplicates
from pipeline.look.store.features import FeatureRows, Outlier, SampledRows
from pipeline.look.store.flaws import flaw_of, listed

DEAD = 1e-3
"""Spread of a slot's numbers, beside their size, below which it says nothing."""
_TWIN_SHARE = 0.5
_STILL_ROWS = 3


def feature_flaws(
    episodes: Sequence[EpisodeCoverage],
    found: FeatureRows,
    outliers: Sequence[Outlier],
    duplicates: Duplicates,
) -> Iterator[Flaw]:
    """Of the sampled rows; times are s since the episode's first tick."""
    yield from _dead_slots(found)
    yield from _still_episodes(episodes, found)
    yield from _outliers(episodes, outliers)
    yield from _twins(episodes, duplicates)


def broken_rows(
    episodes: Sequence[EpisodeCoverage],
    sampled: SampledRows,
    broken: NDArray[np.bool_],
    slots: Sequence[str],
) -> Iterator[Flaw]:
    """The episodes of the rows (row, slot) with features that are no numbers."""
    places = zip(*(each.tolist() for each in np.nonzero(broken)), strict=True)
    for index, group in groupby(places, key=lambda one: int(sampled.episode[one[0]])):
        these = list(group)
        rows = sorted({row for row, _ in these})
        first, slot = these[0]
        said = f"{len(rows)} VL row(s) with features that are NaN or infinite, the first in slot "
        said += f"{slots[slot]} at {sampled.time[first]:.2f} s; left out of all that is shown of "
        said += "features. Training refuses them: extract these rows anew"
        span = (float(sampled.time[first]), float(sampled.time[rows[-1]]))
        yield flaw_of(episodes[index], "not finite", "vl/features", said, span, error=True)


def _dead_slots(found: FeatureRows) -> Iterator[Flaw]:
    norms = found.norms
    pairs = zip(norms.names, norms.variation, strict=True)
    dead = [name for name, variation in pairs if variation < DEAD]
    if dead:
        said = f"{listed(dead)}: the same in all {len(found.sampled.rows)} VL rows looked at; "
        said += "expected features that follow the scene (is a camera dead, or its view black?)"
        yield Flaw(kind="dead slot", severity="warning", stream="vl/features", message=said)


def _still_episodes(episodes: Sequence[EpisodeCoverage], found: FeatureRows) -> Iterator[Flaw]:
    """Slots that are alive elsewhere and do not vary within an episode."""
    alive = found.norms.variation >= DEAD
    counts = np.bincount(found.sampled.episode, minlength=len(episodes))
    for one, within, rows in zip(episodes, found.norms.within, counts, strict=True):
        still = [found.norms.names[slot] for slot in np.flatnonzero((within < DEAD) & alive)]
        if still and rows >= _STILL_ROWS:
            said = f"{listed(still)}: the same in all {rows} VL rows looked at of this episode; "
            said += "expected them to follow the scene"
            yield flaw_of(one, "still features", "vl/features", said)


def _outliers(episodes: Sequence[EpisodeCoverage], outliers: Sequence[Outlier]) -> Iterator[Flaw]:
    for index, group in groupby(outliers, key=lambda one: one.episode):
        these = list(group)
        worst = max(these, key=lambda one: one.deviations)
        times = [one.time_s for one in these]
        said = f"{len(these)} feature norm(s) far from the rest, the furthest {worst.norm:.4g} in "
        said += f"slot {worst.slot}, of which the median is {worst.median:.4g}"
        span = (min(times), max(times))
        yield flaw_of(episodes[index], "feature norm", "vl/features", said, span)


def _twins(episodes: Sequence[EpisodeCoverage], duplicates: Duplicates) -> Iterator[Flaw]:
    """Pairs of episodes of which one says little that the other does not."""
    named = {one.name: one for one in episodes}
    equal = {(one.first, one.second) for one in duplicates.equal_twins}
    for one in duplicates.equal_twins:
        if one.share >= _TWIN_SHARE:
            said = f"{one.rows[0]} of its VL rows have the very frames and prompt of "
            said += f"{one.rows[1]} rows of {one.second}"
            span = (one.time_s[0], None)
            yield flaw_of(named[one.first], "same recording", "vl/key", said, span)
    for one in duplicates.twins:
        if one.share >= _TWIN_SHARE and (one.first, one.second) not in equal:
            said = f"{one.rows[0]} of its VL rows look like {one.rows[1]} rows of {one.second} "
            said += f"(similarity at least {duplicates.threshold:g})"
            span = (one.time_s[0], None)
            yield flaw_of(named[one.first], "near-duplicate episodes", "vl/features", said, span)
