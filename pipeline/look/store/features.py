"""The features of a store: how long they are by slot, and which of them do not vary.

One slot of at most `inspect.points` VL rows is in memory at a time. Of augmented variants, the
plain frames are looked at.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.bfloat16 import widen
from pipeline.base.channels import named
from pipeline.base.errors import StoreIncomplete
from pipeline.base.finite import non_finite
from pipeline.base.issue import Issue
from pipeline.look.page.blocks import Block, Picture, Text
from pipeline.look.page.style import GRID, INK, PALETTE, canvas
from pipeline.look.store.channels import evenly
from pipeline.look.store.episodes import EpisodeCoverage, mark_sources
from pipeline.store import FEATURES, FeatureStore, place
from pipeline.store.chunks import row_checksums
from pipeline.store.repair_hints import mend

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
    features, wanted = store.array(FEATURES), store.array("vl/checksum")
    for block in _blocks(rows, features[:1].nbytes):
        bad = block[row_checksums(features[block]) != wanted[block]]
        if len(bad):
            raise StoreIncomplete(
                f"{store.path}: expected features that give their checksum, found {len(bad)} VL "
                f"row(s) that do not, the first {place(store, 'vl', int(bad[0]))}: the store is "
                f"damaged. {mend(store.path)}"
            )


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
    names = slot_names(store)[:slots]  # variants repeat them
    return FeatureNorms(sampled, names, norm, variation, within, broken)


def read_slot(store: FeatureStore, rows: NDArray[np.int64], slot: int) -> NDArray[np.float32]:
    """(row, dim) of one slot of the plain frames, whatever dtype it is stored in."""
    features = store.array(FEATURES)
    blocks = [widen(features[block, slot]) for block in _blocks(rows, features[0, :1].nbytes)]
    return np.concatenate(blocks).astype(np.float32, copy=False)


def slot_names(store: FeatureStore) -> tuple[str, ...]:
    """(slot,) of all variants, in a few words each."""
    return tuple(_slot_name(document) for document in store.attrs["slots"])


def _slot_name(document: Mapping[str, Any]) -> str:
    cell = ",".join(map(str, document.get("cell") or ()))
    layer = f"layer {document['layer']}{'' if document['norm'] else ' no norm'}"
    return " ".join(filter(None, (layer, document["pooling"], document.get("view"), cell)))


def _blocks(rows: NDArray[np.int64], row_bytes: int) -> list[NDArray[np.int64]]:
    return np.array_split(rows, max(1, len(rows) * row_bytes // _BLOCK_BYTES))


def _variation(values: NDArray[np.float32]) -> float:
    """The median over numbers of spread / size: huge constant numbers do not hide the others."""
    if len(values) < 2:
        return np.nan
    spread = values.std(axis=0, dtype=np.float64)
    size = np.sqrt(spread**2 + values.mean(axis=0, dtype=np.float64) ** 2)
    return float(np.median(spread / np.maximum(size, _TINY)))


def show_features(norms: FeatureNorms, episodes: Sequence[EpisodeCoverage]) -> list[Block]:
    """How many rows were looked at, and how long their features are."""
    sampled = norms.sampled
    words = "Looked at: all VL rows"
    if len(sampled.rows) < sampled.total:
        words = f"Looked at: {len(sampled.rows):,} of {sampled.total:,} VL rows, the same moments "
        words += "of each episode (`inspect.points`)"
    if broken := int(norms.broken.any(axis=1).sum()):
        words += f", but for what is not finite in {broken:,} of them"
    if not np.isfinite(norms.norm).any():
        return [Text(f"{words}; none has features that are numbers.")]
    return [
        Text(f"{words}. Of augmented variants, plain frames only."),
        Picture(
            "norms",
            "Left: how long the features of each slot are. Right: their median length in each "
            "episode divided by that in all; a column that stands out is an episode unlike others.",
            partial(draw_norms, norms, episodes),
        ),
    ]


def draw_norms(norms: FeatureNorms, episodes: Sequence[EpisodeCoverage]) -> Figure:
    """Length of the features: by slot on the left, by slot and episode on the right."""
    slots = len(norms.names)
    figure = canvas(9.5, 3.0 + min(5.0, 0.3 * slots))
    left, right = figure.subplots(1, 2, sharey=True, gridspec_kw={"width_ratios": (1, 1.7)})
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
    _name_slots(left, norms.names)
    _draw_by_episode(figure, right, norms, episodes, middle)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower left", ncols=3)
    return figure


def _draw_by_episode(
    figure: Figure,
    axis: Axes,
    norms: FeatureNorms,
    episodes: Sequence[EpisodeCoverage],
    middle: NDArray[np.float64],
) -> None:
    """The median length in each episode beside that over all, as a map."""
    ratio = np.full((len(middle), len(episodes)), np.nan)
    for index in np.unique(norms.sampled.episode):
        (median,) = _quantiles(norms.norm[norms.sampled.episode == index], (0.5,))
        ratio[:, index] = median / middle
    most = max(0.02, *np.abs(ratio[np.isfinite(ratio)] - 1))
    axis.set_facecolor(GRID)
    image = axis.imshow(
        ratio, _AROUND, aspect="auto", interpolation="nearest", vmin=1 - most, vmax=1 + most
    )
    axis.grid(visible=False)
    axis.tick_params(left=False)
    # The map is light on a dark page too, where ink is white.
    mark_sources(axis, episodes, "#222222")
    figure.colorbar(image, ax=axis, label="median in the episode / in all", pad=0.02)


def _quantiles(norm: NDArray[np.float32], shares: Sequence[float]) -> NDArray[np.float64]:
    """(share, slot) over the rows where it is finite; NaN where it never is."""
    out = np.full((len(shares), norm.shape[1]), np.nan)
    there = np.isfinite(norm).any(axis=0)
    out[:, there] = np.nanquantile(norm[:, there], shares, axis=0)
    return out


def _name_slots(axis: Axes, names: Sequence[str]) -> None:
    """Every slot where they are few, else runs that differ in their cell only."""
    if len(names) <= _NAMED_SLOTS:
        axis.set_yticks(range(len(names)), names)
        return
    middles: list[float] = []
    labels: list[str] = []
    start = 0
    for stem, run in groupby(names, key=_without_cell):
        count = len(list(run))
        middles.append(start + (count - 1) / 2)
        labels.append(stem if count == 1 else f"{stem} ({count})")
        start += count
        axis.axhline(start - 0.5, color=INK, lw=0.6)
    axis.set_yticks(middles, labels)


def _without_cell(name: str) -> str:
    stem, _, last = name.rpartition(" ")
    return stem if "," in last else name


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
        text = f"{named(norms.names, dead)}: the same in all {len(norms.sampled.rows)} VL rows "
        text += "looked at; expected features that follow the scene (is a camera dead, or its view "
        text += "black?)"
        yield Issue(severity="warning", kind="dead slot", message=text, stream=FEATURES)
    far = find_outliers(norms)
    for index, episode in enumerate(episodes):
        own = np.flatnonzero(norms.sampled.episode == index)
        if len(own):
            yield from _issues_of(episode, norms, own, far)


def _issues_of(
    episode: EpisodeCoverage,
    norms: FeatureNorms,
    own: NDArray[np.int64],
    far: NDArray[np.float64],
) -> Iterator[Issue]:
    """Of the rows `own` of an episode."""
    time = norms.sampled.time[own]
    row, slot = np.nonzero(norms.broken[own])
    if len(row):
        text = f"{len(np.unique(row))} VL row(s) with features that are NaN or infinite, the first "
        text += f"in slot {norms.names[slot[0]]} at {time[row[0]]:.2f} s; left out of all that is "
        text += "shown of features. Training refuses them: extract these rows anew"
        span = (float(time[row[0]]), float(time[row[-1]]))
        yield episode.issue("not finite", FEATURES, text, span, "error")
    index = int(norms.sampled.episode[own[0]])
    still = (norms.within[index] < DEAD) & (norms.variation >= DEAD)
    if still.any() and len(own) >= _STILL_ROWS:
        text = f"{named(norms.names, np.flatnonzero(still).tolist())}: the same in all {len(own)} "
        text += "VL rows looked at of this episode; expected them to follow the scene"
        yield episode.issue("still features", FEATURES, text)
    row, slot = np.nonzero(far[own])
    if len(row):
        worst = far[own][row, slot].argmax()
        column, name = norms.norm[:, slot[worst]], norms.names[slot[worst]]
        text = f"{len(row)} feature norm(s) far from the rest, the furthest "
        text += f"{column[own[row[worst]]]:.4g} in slot {name}, of which the median is "
        text += f"{np.nanmedian(column):.4g}"
        span = (float(time[row[0]]), float(time[row[-1]]))
        yield episode.issue("feature norm", FEATURES, text, span)
