"""How old the features of a store are at each tick that uses them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline.base.issue import Issue
from pipeline.base.table import Table
from pipeline.data.timeline import COARSEST_S
from pipeline.look.page.blocks import Block, Picture, Text
from pipeline.look.page.style import INK, PALETTE, canvas
from pipeline.look.store.episodes import EpisodeCoverage
from pipeline.store import FeatureStore

_BLOCK_TICKS = 65536
_STALE_PERIODS = 2
_BINS = 48


@dataclass(frozen=True, eq=False)
class Ages:
    """How old the features are at each tick: time of the tick less capture time of the frame."""

    newest: NDArray[np.float32]
    """(tick,) s since the newest frame, as `FeatureStore.feature_age` says."""
    by_view: NDArray[np.float32]
    """(tick, view) s since the frame of each view; NaN where the view is missing."""
    views: tuple[str, ...]
    vlm_reuse_count: int
    period_s: float
    """Time from one VL row to the next: `vlm_reuse_count` median steps of the ticks; NaN where no
    episode has two ticks."""


def read_ages(store: FeatureStore) -> Ages:
    """Read all ticks in blocks; neither features nor readings are read."""
    views = tuple(store.streams["views"])
    newest = np.empty(store.ticks, np.float32)
    by_view = np.empty((store.ticks, len(views)), np.float32)
    time, row_of = store.array("tick/time"), store.array("tick/vl_row")
    shown = store.array("vl/frame_time")
    for start in range(0, store.ticks, _BLOCK_TICKS):
        ticks = np.arange(start, min(start + _BLOCK_TICKS, store.ticks))
        newest[ticks] = store.feature_age(ticks)
        by_view[ticks] = time[ticks, None] - shown[row_of[ticks]]
    reuse = store.vlm_reuse_count
    return Ages(newest, by_view, views, reuse, reuse * store.tick_step())


def show_ages(ages: Ages) -> list[Block]:
    """What an age is, its picture, and its spread for each view."""
    ages_of = {"newest frame": ages.newest, **dict(zip(ages.views, ages.by_view.T, strict=True))}
    finite = {name: age[np.isfinite(age)] for name, age in ages_of.items()}
    rows = [
        (name, *np.quantile(age, (0.01, 0.5, 0.99, 1.0)).tolist())
        for name, age in finite.items()
        if len(age)
    ]
    return [
        Text(
            "Ticks between two VL rows reuse the last, so what the model saw grows older until the "
            "next; a camera slower than the ticks adds to it. The policy is given the age of the "
            "newest frame as `feature_age`."
        ),
        Picture(
            "ages",
            "Share of the ticks by the age of what they see: of the newest frame, filled, and of "
            "each view's; the dashed line is the time of one VL row.",
            partial(draw_ages, ages),
        ),
        Table(("age [s] of", "1 %", "median", "99 %", "oldest"), rows),
    ]


def draw_ages(ages: Ages) -> Figure:
    """How many ticks see features how old: since the newest frame, and since that of each view."""
    figure = canvas(8.5, 3.6)
    axis = figure.subplots()
    all_ages = np.concatenate([ages.newest, ages.by_view[np.isfinite(ages.by_view)]])
    low = min(0.0, float(all_ages.min()))
    edges = np.linspace(low, max(float(all_ages.max()), low + 1e-3), _BINS + 1)

    def shares(age: NDArray[np.float32]) -> NDArray[np.float64]:
        counts = np.histogram(age[np.isfinite(age)], edges)[0]
        return counts * (100 / max(1, counts.sum()))

    label = "newest frame (feature_age)"
    newest = shares(ages.newest)
    axis.stairs(newest, edges, fill=True, color=PALETTE[0], alpha=0.55, label=label)
    for column, name in enumerate(ages.views):
        colour = PALETTE[(column + 1) % len(PALETTE)]
        axis.stairs(shares(ages.by_view[:, column]), edges, color=colour, lw=1.6, label=name)
    if np.isfinite(ages.period_s):
        label = f"one VL row ({ages.vlm_reuse_count} ticks)"
        axis.axvline(ages.period_s, color=INK, ls="--", lw=1.2, label=label)
    axis.set_xlabel("age of what the model saw, at each tick [s]")
    axis.set_ylabel("ticks [%]")
    figure.legend(loc="outside lower center", ncols=5)
    return figure


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
            span = _span(time, ahead)
            yield episode.issue("frames from the future", "vl/frame_time", text, span, "error")
        if len(old):
            text = f"{len(old)} of {len(age)} ticks see features up to {age.max():.2f} s old; "
            text += f"expected less than {limit:.2f} s, the time of {_STALE_PERIODS} VL rows"
            yield episode.issue("old frames", "vl/frame_time", text, _span(time, old))


def _span(time: NDArray[np.float64], ticks: NDArray[np.int64]) -> tuple[float, float]:
    return float(time[ticks[0]] - time[0]), float(time[ticks[-1]] - time[0])
