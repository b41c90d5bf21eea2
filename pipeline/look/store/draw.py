"""Pictures of a store: which episodes have what, how old features are, what takes the space."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from pipeline.base.channels import PROFILE_CHANNELS, unnumbered
from pipeline.base.format import size
from pipeline.look.page.style import GRID, INK, PALETTE, canvas
from pipeline.look.recording.channels import ChannelStatistics
from pipeline.look.store.facts import Ages, ArraySize, EpisodeCoverage, StoreView

_ABSENT, _PARTLY, _PRESENT = "#D55E00", "#E69F00", "#0072B2"
_SIZES = 8
_BINS = 48
_NAMED_EPISODES = 16
_NAME_ENDS = 6, 15
"""Characters of a long name's begin and end that are shown."""


def coverage(view: StoreView) -> Figure:
    """Length of each episode above, and below which streams and views its ticks see."""
    streams = list(view.episodes[0].covered)
    figure = canvas(9.0, 3.8 + 0.3 * len(streams))
    ratios = (2.2, 0.3 * len(streams) + 0.2)
    above, below = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": ratios})
    at = np.arange(len(view.episodes))
    for number, source in enumerate(view.sources):
        own = [one.source == source for one in view.episodes]
        seconds = [one.seconds for one in view.episodes if one.source == source]
        above.bar(at[own], seconds, 0.9, color=PALETTE[number % len(PALETTE)], label=source)
    above.set_ylabel("length [s]")
    above.grid(axis="x", visible=False)
    shares = np.array([[one.covered[name] for one in view.episodes] for name in streams])
    colours = ListedColormap([_ABSENT, _PARTLY, _PRESENT])
    levels = np.where(shares == 0, 0, np.where(shares < 1, 1, 2))
    grid = np.arange(-0.5, len(at) + 0.5), np.arange(-0.5, len(streams) + 0.5)
    norm = BoundaryNorm([-0.5, 0.5, 1.5, 2.5], 3)
    mesh = below.pcolormesh(*grid, levels, cmap=colours, norm=norm, rasterized=True)
    mesh.set_edgecolor("face")
    below.set_yticks(range(len(streams)), streams)
    below.invert_yaxis()
    below.grid(visible=False)
    mark_sources(below, view.episodes)
    kinds = [(_PRESENT, "seen by all ticks"), (_PARTLY, "by some"), (_ABSENT, "absent")]
    patches = [Patch(color=colour, label=label) for colour, label in kinds]
    figure.legend(handles=patches, loc="outside lower center", ncols=3)
    if len(view.sources) > 1:
        above.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(view.sources))
    return figure


def ages(view: StoreView) -> Figure:
    """How many ticks see features how old: since the newest frame, and since that of each view."""
    found = view.ages
    figure = canvas(8.5, 3.6)
    axis = figure.subplots()
    edges = _edges(found)
    weights = np.full(len(found.newest), 100 / max(1, len(found.newest)))
    axis.hist(
        found.newest,
        edges.tolist(),
        weights=weights,
        color=PALETTE[0],
        alpha=0.55,
        label="newest frame (feature_age)",
    )
    for column, name in enumerate(found.views):
        age = found.by_view[:, column]
        age = age[np.isfinite(age)]
        counts = np.histogram(age, edges)[0] * (100 / max(1, len(age)))
        colour = PALETTE[(column + 1) % len(PALETTE)]
        axis.stairs(counts, edges, color=colour, lw=1.6, label=name)
    if np.isfinite(found.period_s):
        said = f"one VL row ({view.vlm_reuse_count} ticks)"
        axis.axvline(found.period_s, color=INK, ls="--", lw=1.2, label=said)
    axis.set_xlabel("age of what the model saw, at each tick [s]")
    axis.set_ylabel("ticks [%]")
    figure.legend(loc="outside lower center", ncols=5)
    return figure


def sizes(view: StoreView) -> Figure:
    """Bytes on the disk by array, the largest first, the small ones together."""
    shown = _largest(view.sizes)
    figure = canvas(8.5, 1.1 + 0.34 * len(shown))
    axis = figure.subplots()
    taken = np.array([count for _, count in shown]) / 2**20
    at = np.arange(len(shown))
    axis.barh(at, taken, 0.7, color=PALETTE[0])
    for place, (_, count) in enumerate(shown):
        share = count / max(1, view.disk_bytes)
        said = f"{size(count)}, {share:.1%}" if share >= 0.001 else size(count)
        beside: dict[str, Any] = {
            "xytext": (5, 0),
            "textcoords": "offset points",
            "va": "center",
            "size": 9,
        }
        axis.annotate(said, (count / 2**20, place), **beside)
    axis.set_yticks(at, [name for name, _ in shown])
    axis.invert_yaxis()
    axis.set_xlim(0, max(taken.max() * 1.25, 1e-3))
    axis.set_xlabel("on the disk [MiB]")
    axis.grid(axis="y", visible=False)
    return figure


def wide_channels(view: StoreView) -> Figure:
    """Every channel of each numbered run (such as an A-scan): median, 1 to 99 %, and extremes."""
    runs = list(numbered(view))
    figure = canvas(8.5, 0.6 + 2.6 * len(runs))
    axes = figure.subplots(len(runs), 1, squeeze=False)[:, 0]
    for axis, channels in zip(axes, runs, strict=True):
        _band(axis, channels)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def numbered(view: StoreView) -> Iterator[tuple[ChannelStatistics, ...]]:
    """Runs of channels that make a profile."""
    for stream in view.statistics:
        for _, run in groupby(stream.channels, key=lambda one: (unnumbered(one.name), one.unit)):
            channels = tuple(run)
            if len(channels) >= PROFILE_CHANNELS:
                yield channels


def mark_sources(axis: Axes, episodes: Sequence[EpisodeCoverage], line: str = INK) -> None:
    """Sources below an axis of episodes, parted by lines; the episodes' names where few."""
    starts = [index for index in range(len(episodes)) if not index or _begins(episodes, index)]
    for start in starts[1:]:
        axis.axvline(start - 0.5, color=line, lw=1.0)
    if len(episodes) <= _NAMED_EPISODES:
        one_source = len(starts) == 1
        names = [_short(one.id if one_source else one.name) for one in episodes]
        axis.set_xticks(range(len(episodes)), names, rotation=45, ha="right")
        return
    stops = [*starts[1:], len(episodes)]
    middle = [(start + stop - 1) / 2 for start, stop in zip(starts, stops, strict=True)]
    said = [f"{episodes[at].source}\n{stop - at}" for at, stop in zip(starts, stops, strict=True)]
    axis.set_xticks(middle, said)
    axis.set_xlabel("episodes, by source")


def _short(name: str) -> str:
    """Of a long name, both ends: where it belongs and what tells it from its neighbours."""
    most = _NAME_ENDS[0] + _NAME_ENDS[1] + 1
    return name if len(name) <= most else f"{name[: _NAME_ENDS[0]]}…{name[-_NAME_ENDS[1] :]}"


def _begins(episodes: Sequence[EpisodeCoverage], index: int) -> bool:
    return episodes[index].source != episodes[index - 1].source


def _edges(found: Ages) -> np.ndarray:
    """From the youngest to the oldest of all, as far as that is finite."""
    low = min(0.0, float(found.newest.min()), _least(found.by_view))
    high = max(float(found.newest.max()), -_least(-found.by_view), low + 1e-3)
    return np.linspace(low, high, _BINS + 1)


def _least(values: np.ndarray) -> float:
    return float(np.fmin.reduce(values, axis=None, initial=np.inf))


def _largest(arrays: Sequence[ArraySize]) -> list[tuple[str, int]]:
    shown = [(one.name, one.disk_bytes) for one in arrays[:_SIZES]]
    rest = sum(one.disk_bytes for one in arrays[_SIZES:])
    return [*shown, (f"{len(arrays) - _SIZES} others", rest)] if rest else shown


def _band(axis: Axes, channels: Sequence[ChannelStatistics]) -> None:
    at = np.arange(len(channels))
    low, high = [one.minimum for one in channels], [one.maximum for one in channels]
    axis.fill_between(at, low, high, color=GRID, label="least to greatest")
    low, high = [one.low for one in channels], [one.high for one in channels]
    axis.fill_between(at, low, high, color=PALETTE[4], alpha=0.5, lw=0, label="1 to 99 %")
    axis.plot(at, [one.median for one in channels], color=PALETTE[0], lw=1.2, label="median")
    unit = f" [{channels[0].unit}]" if channels[0].unit else ""
    axis.set_ylabel(f"{channels[0].stream}{unit}")
    axis.set_xlabel(f"channel: {channels[0].name} to {channels[-1].name}")
    axis.margins(x=0)
