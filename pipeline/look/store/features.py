"""The features of a store: how long they are by slot, and which of them do not vary.

One slot of at most `inspect.points` VL rows is in memory at a time. Of augmented variants, the
plain frames are looked at.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.arrays import non_finite, widen
from pipeline.base.channels import named
from pipeline.base.issue import Issue
from pipeline.look.page.blocks import Block, Picture, Text
from pipeline.look.page.style import GRID, PALETTE, draw_map, panels
from pipeline.look.store.channels import evenly
from pipeline.look.store.episodes import EpisodeCoverage, mark_sources
from pipeline.store import FEATURES, FeatureStore
from pipeline.store.chunks import check_row_checksums
from pipeline.store.schema import read_spec
from pipeline.vlm.slots import slot_name

DEAD = 1e-3
"""Spread of a slot's numbers, beside their size, below which it says nothing."""
_BLOCK_BYTES = 2**24
_TINY = 1e-30
_FAR, _FAR_SHARE = 10.0, 0.5
_FEWEST = 20
"""Rows below which nothing is far from the rest."""
_STILL_ROWS = 3
_NAMED_SLOTS = 20
_AROUND = LinearSegmentedColormap.from_list("around", ("#0072B2", "#f0f0f0", "#D55E00"))


@dataclass(frozen=True, eq=False)
class SampledRows:
    """The VL rows that are looked at: all, or every so many of each episode."""

    rows: NDArray[np.int64]
    """(row,) store-global, ascending."""
    episode: NDArray[np.int64]
    """(row,) index of the episode."""
    time: NDArray[np.float64]
    """(row,) of the tick it was computed for, in s since the episode's first."""
    total: int
    """VL rows of the store."""


@dataclass(frozen=True, eq=False)
class FeatureNorms:
    """Length and spread of the sampled features, by slot."""

    sampled: SampledRows
    names: tuple[str, ...]
    """(slot,)"""
    norm: NDArray[np.float32]
    """(row, slot) Euclidean; NaN where the slot is invalid or holds what is no number."""
    variation: NDArray[np.float64]
    """(slot,) the median over its numbers of standard deviation / root mean square: 0 = dead."""
    within: NDArray[np.float64]
    """(episode, slot) the same within an episode; NaN with fewer than two sampled rows."""
    broken: NDArray[np.bool_]
    """(row, slot) valid, but NaN or infinite."""


def sample_rows(store: FeatureStore, most: int) -> SampledRows:
    """At most `most` VL rows: all, or every so many of each episode from its first.

    Of more episodes than `most`, evenly spread ones.
    """
    edges, time = store.array("episode/vl_start"), store.array("vl/time")
    lengths, total = np.diff(edges), int(edges[-1])
    step = 1
    while step < lengths.max() and (-(-lengths // step)).sum() > most:
        step += 1
    rows = np.flatnonzero((np.arange(total) - np.repeat(edges[:-1], lengths)) % step == 0)
    rows = rows[evenly(len(rows), most)]
    episode = np.searchsorted(edges, rows, side="right") - 1
    return SampledRows(rows, episode, time[rows] - time[edges[episode]], total)


def check_rows(store: FeatureStore, rows: NDArray[np.int64]) -> None:
    """Raise `StoreIncomplete` where one of these VL rows does not give its checksum."""
    features, checksums = store.array(FEATURES), store.array("vl/checksum")
    spec = read_spec(store.path, FEATURES)
    for block in np.array_split(rows, max(1, len(rows) * features[:1].nbytes // _BLOCK_BYTES)):
        check_row_checksums(store.path, spec, block, features[block], checksums[block])


def look_at_features(store: FeatureStore, sampled: SampledRows) -> FeatureNorms:
    """Norms and variation of these rows, in one pass, slot after slot."""
    count, slots = len(sampled.rows), store.feature_shape[0]
    norm = np.full((count, slots), np.nan, np.float32)
    variation = np.full(slots, np.nan)
    within = np.full((len(store.episodes), slots), np.nan)
    broken = np.zeros((count, slots), np.bool_)
    for slot in tqdm(range(slots), desc="look at features", unit="slot", disable=None):
        values = read_slot(store, sampled.rows, slot)
        valid = store.array("vl/slot_valid")[sampled.rows, slot] != 0
        broken[:, slot] = valid & non_finite(values).any(axis=1)
        valid &= ~broken[:, slot]
        norm[valid, slot] = np.linalg.norm(values[valid], axis=1)
        variation[slot] = _variation(values[valid])
        for episode in np.unique(sampled.episode[valid]):
            within[episode, slot] = _variation(values[valid & (sampled.episode == episode)])
    # Variants repeat the names.
    names = tuple(slot_name(document) for document in store.attrs["slots"][:slots])
    return FeatureNorms(sampled, names, norm, variation, within, broken)


def read_slot(store: FeatureStore, rows: NDArray[np.int64], slot: int) -> NDArray[np.float32]:
    """(row, dim) of one slot of the plain frames, whatever dtype it is stored in."""
    return widen(store.array(FEATURES)[rows, slot]).astype(np.float32, copy=False)


def _variation(values: NDArray[np.float32]) -> float:
    """The median over numbers of spread / size: huge constant numbers do not hide the others."""
    if len(values) < 2:
        return np.nan
    spread = values.std(axis=0, dtype=np.float64)
    size = np.sqrt(spread**2 + values.mean(axis=0, dtype=np.float64) ** 2)
    return float(np.median(spread / np.maximum(size, _TINY)))


def show_features(norms: FeatureNorms, episodes: Sequence[EpisodeCoverage]) -> list[Block]:
    """How many rows were looked at, and how long their features are."""
    looked_at, total = len(norms.sampled.rows), norms.sampled.total
    words = "Looked at: all VL rows"
    if looked_at < total:
        words = f"Looked at: {looked_at:,} of {total:,} VL rows (`inspect.points`)"
    if broken := int(norms.broken.any(axis=1).sum()):
        words += f", but for what is not finite in {broken:,} of them"
    if not np.isfinite(norms.norm).any():
        return [Text(f"{words}; none has features that are numbers.")]
    caption = "Length of the features by slot, and the median in each episode / in all."
    picture = Picture("norms", caption, partial(draw_norms, norms, episodes))
    return [Text(f"{words}. Of augmented variants, plain frames only."), picture]


def draw_norms(norms: FeatureNorms, episodes: Sequence[EpisodeCoverage]) -> Figure:
    """Length of the features: by slot on the left, by slot and episode on the right."""
    slots = len(norms.names)
    size = 9.5, 3.0 + min(5.0, 0.3 * slots)
    figure, (left, right) = panels(*size, 1, 2, sharey=True, width_ratios=(1, 1.7))
    at = np.arange(slots)
    low, middle, high = _quantiles(norms.norm, (0.01, 0.5, 0.99))
    left.hlines(at, low, high, color=PALETTE[4], lw=min(5.0, 160 / slots), label="1 to 99 %")
    left.plot(middle, at, "o", color=PALETTE[0], ms=min(5.0, 120 / slots), label="median")
    row, slot = np.nonzero(find_outliers(norms) > 0)
    if len(row):
        far = norms.norm[row, slot]
        left.plot(far, slot, "x", color=PALETTE[5], label="outlier", zorder=4)
    left.set_xlabel("norm of the features")
    left.set_ylim(slots - 0.5, -0.5)
    # Of many slots, the first of those that differ in their cell only.
    stems = [re.sub(r" \d+,\d+$", "", name) for name in norms.names]
    if slots <= _NAMED_SLOTS:
        stems = norms.names
    first = [number for number in range(slots) if stems[number] not in stems[:number]]
    left.set_yticks(first, [stems[number] for number in first])
    ratio = np.full((slots, len(episodes)), np.nan)
    for index in np.unique(norms.sampled.episode):
        (median,) = _quantiles(norms.norm[norms.sampled.episode == index], (0.5,))
        ratio[:, index] = median / middle
    most = max(0.02, *np.abs(ratio[np.isfinite(ratio)] - 1))
    right.set_facecolor(GRID)
    image = draw_map(right, ratio, (1 - most, 1 + most), _AROUND, numbered=False)
    right.tick_params(left=False)
    mark_sources(right, episodes)
    figure.colorbar(image, ax=right, label="median in the episode / in all", pad=0.02)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower left", ncols=3)
    return figure


def _quantiles(norm: NDArray[np.float32], shares: Sequence[float]) -> NDArray[np.float64]:
    """(share, slot) over the rows where it is finite; NaN where it never is."""
    out = np.full((len(shares), norm.shape[1]), np.nan)
    there = np.isfinite(norm).any(axis=0)
    out[:, there] = np.nanquantile(norm[:, there], shares, axis=0)
    return out


def find_outliers(norms: FeatureNorms) -> NDArray[np.float64]:
    """(row, slot) robust deviations of a norm that is far from its slot's median, else 0.

    Far is further than ten deviations (1.4826 x the median distance) and than half of the median:
    Iglewicz and Hoaglin's score, with a wider bound as norms are many.
    """
    norm = np.ma.masked_invalid(norms.norm.astype(np.float64))
    median = np.ma.median(norm, axis=0)
    distance = np.abs(norm - median)
    deviations = distance / np.maximum(1.4826 * np.ma.median(distance, axis=0), _TINY)
    far = (deviations > _FAR) & (distance > _FAR_SHARE * median) & (len(norm) >= _FEWEST)
    return np.ma.where(far, deviations, 0).filled(0)


def find_feature_issues(
    norms: FeatureNorms, episodes: Sequence[EpisodeCoverage]
) -> Iterator[Issue]:
    """Dead slots, odd lengths and what is no number; times are s since the episode's first tick."""
    dead = np.flatnonzero(norms.variation < DEAD).tolist()
    if dead:
        text = f"{named(norms.names, dead)}: the same in all VL rows looked at"
        yield Issue(severity="warning", kind="dead slot", message=text, stream=FEATURES)
    far = find_outliers(norms)
    still = (norms.within < DEAD) & (norms.variation >= DEAD)
    for index, episode in enumerate(episodes):
        own = np.flatnonzero(norms.sampled.episode == index)
        time = norms.sampled.time[own]
        if len(row := np.nonzero(norms.broken[own])[0]):
            slot, span = norms.broken[own[row[0]]].argmax(), time[row[[0, -1]]]
            text = f"{len(np.unique(row))} VL row(s) are NaN or infinite, the first in slot "
            text += f"{norms.names[slot]}; training refuses them: extract them anew"
            yield episode.issue("not finite", FEATURES, text, *span, severity="error")
        if len(own) >= _STILL_ROWS and still[index].any():
            slots = named(norms.names, np.flatnonzero(still[index]).tolist())
            text = f"{slots}: the same in all {len(own)} VL rows looked at of this episode"
            yield episode.issue("still features", FEATURES, text)
        if len(row := np.nonzero(far[own])[0]):
            worst, slot = np.unravel_index(far[own].argmax(), far[own].shape)
            column = norms.norm[:, slot]
            text = f"{len(row)} feature norm(s) far from the rest, as {column[own[worst]]:.4g} in "
            text += f"slot {norms.names[slot]}, of which the median is {np.nanmedian(column):.4g}"
            yield episode.issue("feature norm", FEATURES, text, *time[row[[0, -1]]])
