"""The features of a store: how long they are, what does not vary, which rows lie near each other.

One slot of at most `inspect.points` VL rows is in memory at a time, beside two matrices of all
pairs of these rows (8 bytes x points^2). Of augmented variants, the plain frames are looked at.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.look.store.statistics import evenly
from pipeline.store import FEATURES, FeatureStore

_BLOCK_ROWS = 1024
_TINY = 1e-30
_FAR, _FAR_SHARE = 10.0, 0.5
_FEWEST = 20
"""Rows below which nothing is far from the rest."""


@dataclass(frozen=True, eq=False)
class SampledRows:
    """The VL rows that are looked at: all, or every so many of each episode."""

    rows: NDArray[np.int64]
    """(row,) store-global, ascending."""
    episode: NDArray[np.int64]
    """(row,) index of the episode."""
    time: NDArray[np.float64]
    """(row,) of the tick it was computed for, in s since the episode's first."""
    progress: NDArray[np.float64]
    """(row,) 0 at the episode's first VL row, 1 at its last."""
    total: int
    """VL rows of the store."""
    left_out: int = 0
    """VL rows that were looked at and are not among `rows`, as they hold what is no number."""

    @property
    def looked_at(self) -> int:
        """VL rows, those that were left out among them."""
        return len(self.rows) + self.left_out

    def but(self, broken: NDArray[np.bool_]) -> "SampledRows":
        """All rows but these (row,), which are counted as left out."""
        return replace(
            self,
            rows=self.rows[~broken],
            episode=self.episode[~broken],
            time=self.time[~broken],
            progress=self.progress[~broken],
            left_out=self.left_out + int(broken.sum()),
        )


@dataclass(frozen=True, eq=False)
class SlotNorms:
    """Length of the features, by slot."""

    names: tuple[str, ...]
    """(slot,)"""
    norm: NDArray[np.float32]
    """(row, slot) Euclidean; NaN where the slot is invalid."""
    variation: NDArray[np.float64]
    """(slot,) the median over its numbers of standard deviation / root mean square: 0 = dead."""
    within: NDArray[np.float64]
    """(episode, slot) the same within an episode; NaN with fewer than two sampled rows."""


@dataclass(frozen=True, eq=False)
class FeatureRows:
    """What one pass over the sampled rows found."""

    sampled: SampledRows
    norms: SlotNorms
    gram: NDArray[np.float32]
    """(row, row) dot products of all valid slots side by side, each less its mean over the rows."""


@dataclass(frozen=True)
class Outlier:
    """A feature much longer or shorter than its slot's others."""

    episode: int
    time_s: float
    row: int
    """Store-global VL row."""
    slot: str
    norm: float
    median: float
    """Of the slot over all sampled rows."""
    deviations: float
    """Distance from the median, in robust standard deviations (1.4826 x the median distance)."""


def sample_rows(store: FeatureStore, most: int) -> SampledRows:
    """At most `most` VL rows: all, or every so many of each episode from its first.

    The same moments of all episodes, so that a recording that is there twice is seen twice. Of more
    episodes than `most`, evenly spread ones.
    """
    edges, time = store.array("episode/vl_start"), store.array("vl/time")
    lengths, total = np.diff(edges), int(edges[-1])
    step = 1
    while step < lengths.max() and (-(-lengths // step)).sum() > most:
        step += 1
    inside = np.arange(total) - np.repeat(edges[:-1], lengths)
    rows = np.flatnonzero(inside % step == 0)
    rows = rows[evenly(len(rows), most)]
    episode = np.searchsorted(edges, rows, side="right") - 1
    progress = inside[rows] / np.maximum(1, lengths[episode] - 1)
    return SampledRows(rows, episode, time[rows] - time[edges[episode]], progress, total)


def look_at_features(store: FeatureStore, sampled: SampledRows) -> FeatureRows:
    """Norms, variation and dot products of these finite rows, in one pass, slot after slot."""
    count, slots = len(sampled.rows), store.feature_shape[0]
    names = slot_names(store)[:slots]  # variants repeat them
    norm = np.full((count, slots), np.nan, np.float32)
    variation = np.full(slots, np.nan)
    within = np.full((len(store.episodes), slots), np.nan)
    gram = np.zeros((count, count), np.float32)
    for slot in tqdm(range(slots), desc="look at features", unit="slot", disable=None):
        valid = store.array("vl/slot_valid")[sampled.rows, slot] != 0
        values = read_slot(store, sampled.rows, slot)
        norm[valid, slot] = np.linalg.norm(values[valid], axis=1)
        variation[slot] = _variation(values[valid])
        for episode, rows in _episodes(sampled.episode, valid):
            within[episode, slot] = _variation(values[rows])
        values -= values[valid].mean(axis=0, dtype=np.float64) if valid.any() else 0
        values[~valid] = 0
        gram += values @ values.T
    return FeatureRows(sampled, SlotNorms(names, norm, variation, within), gram)


def outliers(found: FeatureRows) -> tuple[Outlier, ...]:
    """Norms further from their slot's median than ten deviations and than half of the median.

    In order of episodes; Iglewicz and Hoaglin's score, with a wider bound as norms are many.
    """
    norm, names = found.norms.norm, found.norms.names
    if len(norm) < _FEWEST:
        return ()
    with np.errstate(invalid="ignore"):
        filled = np.ma.masked_invalid(norm)
        median = np.ma.median(filled, axis=0).filled(np.nan)
        distance = np.abs(norm - median)
        spread = 1.4826 * np.ma.median(np.ma.masked_invalid(distance), axis=0).filled(np.nan)
        far = (distance > _FAR * spread) & (distance > _FAR_SHARE * median)
    sampled = found.sampled
    return tuple(
        Outlier(
            episode=int(sampled.episode[row]),
            time_s=float(sampled.time[row]),
            row=int(sampled.rows[row]),
            slot=names[slot],
            norm=float(norm[row, slot]),
            median=float(median[slot]),
            deviations=float(distance[row, slot] / max(float(spread[slot]), _TINY)),
        )
        for row, slot in np.argwhere(far)
    )


def read_slot(store: FeatureStore, rows: NDArray[np.int64], slot: int) -> NDArray[np.float32]:
    """(row, dim) of one slot of the plain frames, whatever dtype it is stored in."""
    features = store.array(FEATURES)
    out = np.empty((len(rows), features.shape[2]), np.float32)
    for start in range(0, len(rows), _BLOCK_ROWS):
        block = features[rows[start : start + _BLOCK_ROWS], slot]
        if block.dtype == np.uint16:  # the bits of bfloat16 are the upper half of a float32's
            block = (block.astype(np.uint32) << 16).view(np.float32)
        out[start : start + len(block)] = block
    return out


def slot_names(store: FeatureStore) -> tuple[str, ...]:
    """(slot,) of all variants."""
    return tuple(_slot_name(one) for one in store.attrs["slots"])


def _slot_name(document: Mapping[str, Any]) -> str:
    """What a slot is, in a few words, by its entry in the store's attributes."""
    said = f"layer {document['layer']}{'' if document['norm'] else ' no norm'}"
    said += f" {document['pooling']}"
    said += f" {document['view']}" if document.get("view") else ""
    cell = document.get("cell")
    return said if cell is None else f"{said} {cell[0]},{cell[1]}"


def _variation(values: NDArray[np.float32]) -> float:
    """The median over numbers of spread / size: huge constant numbers do not hide the others."""
    if len(values) < 2:
        return np.nan
    spread = values.std(axis=0, dtype=np.float64)
    size = np.sqrt(spread**2 + values.mean(axis=0, dtype=np.float64) ** 2)
    return float(np.median(spread / np.maximum(size, _TINY)))


def _episodes(
    episode: NDArray[np.int64], valid: NDArray[np.bool_]
) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Each episode with valid rows and those rows; `episode` ascends."""
    rows = np.flatnonzero(valid)
    starts = np.flatnonzero(np.diff(episode[rows], prepend=-1))
    for part in np.split(rows, starts[1:]):
        if len(part):
            yield int(episode[part[0]]), part
