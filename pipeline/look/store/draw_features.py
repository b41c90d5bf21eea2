"""Pictures of the features of a store: their length, where they lie, which are alike."""

from collections.abc import Sequence
from itertools import groupby
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline.look.page.style import GRID, INK, PALETTE, canvas
from pipeline.look.store.draw import mark_sources
from pipeline.look.store.facts import StoreProjection, StoreView

PROGRESS = "#0072B2", "#CC79A7", "#E69F00"
"""From an episode's begin to its end, in colours that read on white and on black."""
_AROUND = LinearSegmentedColormap.from_list("around", ("#0072B2", "#f0f0f0", "#D55E00"))
FRAMED_EPISODES = 60
"""Up to which alike pairs are framed; among more, the frames would hide the matrix."""
_NAMED_SLOTS = 20
_MOST_EPISODES = 200
"""Of which the paths are drawn; more are a blot."""


def norms(view: StoreView) -> Figure:
    """Length of the features: by slot on the left, by slot and episode on the right."""
    slots = len(view.norms.names)
    figure = canvas(9.5, 3.0 + min(5.0, 0.3 * slots))
    left, right = figure.subplots(1, 2, sharey=True, gridspec_kw={"width_ratios": (1, 1.7)})
    at = np.arange(slots)
    found = np.ma.masked_invalid(view.norms.norm)
    low, middle, high = (_quantile(view.norms.norm, q) for q in (0.01, 0.5, 0.99))
    left.hlines(at, low, high, color=PALETTE[4], lw=min(5.0, 160 / slots), label="1 to 99 %")
    left.plot(middle, at, "o", color=PALETTE[0], ms=min(5.0, 120 / slots), label="median")
    far = [(one.norm, view.norms.names.index(one.slot)) for one in view.outliers]
    if far:
        left.plot(*zip(*far, strict=True), "x", color=PALETTE[5], label="outlier", zorder=4)
    left.set_xlabel("norm of the features")
    left.set_ylim(slots - 0.5, -0.5)
    _name_slots(left, view.norms.names)
    _by_episode(figure, right, view, found, middle)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower left", ncols=3)
    return figure


def projection(view: StoreView, by: Literal["episode", "progress"]) -> Figure:
    """The first two principal components of the features; episodes beside their sources."""
    found = view.projection
    several = by == "episode" and len(set(found.source.tolist())) > 1
    figure = canvas(9.5 if several else 6.2, 4.6)
    axes = figure.subplots(1, 2 if several else 1, sharex=True, sharey=True, squeeze=False)[0]
    if several:
        _by_source(axes[0], found)
    if by == "episode":
        _paths(axes[-1], found)
    else:
        _by_progress(figure, axes[-1], found)
    for axis in axes:
        axis.set_xlabel(f"component 1 ({found.explained[0]:.0%} of the variance)")
    axes[0].set_ylabel(f"component 2 ({found.explained[1]:.0%})")
    return figure


def likeness(view: StoreView) -> Figure:
    """For each pair of episodes, how alike their most alike VL rows are."""
    found = view.duplicates
    episodes = [view.episodes[index] for index in found.episodes]
    figure = canvas(7.0, 6.2)
    axis = figure.subplots()
    shown = found.likeness
    low = float(np.nanmin(shown))
    axis.set_facecolor(GRID)
    image = axis.imshow(shown, cmap="viridis", vmin=low, vmax=1, interpolation="nearest")
    axis.grid(visible=False)
    mark_sources(axis, episodes)
    axis.set_yticks([])
    axis.set_ylabel("the same episodes")
    label = "highest cosine similarity of two VL rows"
    bar = figure.colorbar(image, ax=axis, label=label, fraction=0.046, pad=0.03)
    bar.ax.axhline(found.threshold, color=PALETTE[5], lw=2)
    if len(episodes) <= FRAMED_EPISODES:
        row, column = np.nonzero(shown >= found.threshold)
        axis.scatter(column, row, 64, marker="s", fc="none", ec=PALETTE[5], lw=1.5)
    return figure


def _by_episode(
    figure: Figure, axis: Axes, view: StoreView, norm: np.ndarray, middle: np.ndarray
) -> None:
    """The median length in each episode beside that over all, as a map."""
    episodes = np.unique(view.sampled.episode)
    ratio = np.full((norm.shape[1], len(view.episodes)), np.nan)
    for index in episodes:
        own = view.norms.norm[view.sampled.episode == index]
        ratio[:, index] = _quantile(own, 0.5) / middle
    most = max(0.02, float(np.nanmax(np.abs(ratio - 1)))) if np.isfinite(ratio).any() else 0.02
    axis.set_facecolor(GRID)
    limits: dict[str, Any] = {"vmin": 1 - most, "vmax": 1 + most}
    image = axis.imshow(ratio, _AROUND, aspect="auto", interpolation="nearest", **limits)
    axis.grid(visible=False)
    axis.tick_params(left=False)
    # The map is light on a dark page too, where ink is white.
    mark_sources(axis, view.episodes, "#222222")
    figure.colorbar(image, ax=axis, label="median in the episode / in all", pad=0.02)


def _quantile(norm: np.ndarray, share: float) -> np.ndarray:
    """(slot,) over the rows where it is valid; NaN where it never is."""
    out = np.full(norm.shape[1], np.nan)
    there = np.isfinite(norm).any(axis=0)
    out[there] = np.nanquantile(norm[:, there], share, axis=0)
    return out


def _name_slots(axis: Axes, names: Sequence[str]) -> None:
    """Every slot where they are few, else runs that differ in their cell only."""
    if len(names) <= _NAMED_SLOTS:
        axis.set_yticks(range(len(names)), names)
        return
    places: list[float] = []
    said: list[str] = []
    start = 0
    for stem, run in groupby(names, key=_without_cell):
        count = len(list(run))
        places.append(start + (count - 1) / 2)
        said.append(stem if count == 1 else f"{stem} ({count})")
        start += count
        axis.axhline(start - 0.5, color=INK, lw=0.6)
    axis.set_yticks(places, said)


def _without_cell(name: str) -> str:
    stem, _, last = name.rpartition(" ")
    return stem if "," in last else name


def _by_source(axis: Axes, found: StoreProjection) -> None:
    for number, source in enumerate(found.sources):
        own = found.source == number
        _dots(axis, found, own, color=PALETTE[number % len(PALETTE)], label=source)
    axis.set_title("by source")
    axis.legend(loc="best", markerscale=1.8, handletextpad=0.1, fontsize=9)


def _by_progress(figure: Figure, axis: Axes, found: StoreProjection) -> None:
    every = np.ones(len(found.points), bool)
    colours = LinearSegmentedColormap.from_list("progress", PROGRESS)
    dots = _dots(axis, found, every, c=found.progress, cmap=colours, vmin=0, vmax=1)
    bar = figure.colorbar(dots, ax=axis, ticks=(0, 1), fraction=0.05, pad=0.02)
    bar.ax.set_yticklabels(("begin", "end"))
    axis.set_title("by progress within the episode")


def _paths(axis: Axes, found: StoreProjection) -> None:
    """The rows of each episode joined in order, in colours that return after six episodes."""
    for index in np.unique(found.episode).tolist():
        own = found.episode == index
        colour = PALETTE[index % len(PALETTE)]
        if index < _MOST_EPISODES:
            path = found.points[own].T
            axis.plot(*path, color=colour, lw=0.6, alpha=0.35, rasterized=True)
        _dots(axis, found, own, color=colour)
    axis.set_title("by episode, in order of time")


def _dots(
    axis: Axes, found: StoreProjection, own: NDArray[np.bool_], **style: Any
) -> PathCollection:
    x, y = found.points[own].T
    return axis.scatter(x, y, s=7, linewidths=0, alpha=0.85, rasterized=True, **style)
