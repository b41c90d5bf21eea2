"""How old the features of a store are at each tick that uses them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline.base.issue import Issue
from pipeline.base.table import Table
from pipeline.data.timeline import COARSEST_S
from pipeline.look.page.blocks import Block, Picture, Text
from pipeline.look.page.style import INK, PALETTE, panels
from pipeline.look.store.episodes import EpisodeCoverage
from pipeline.store import FeatureStore

_STALE_PERIODS = 2
_BINS = 48


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
    """What an age is, its picture, and its spread for each view."""
    rows = [
        (name, *np.nanquantile(age, (0.01, 0.5, 0.99, 1.0)).tolist())
        for name, age in {"newest frame": ages.newest, **ages.by_view}.items()
        if np.isfinite(age).any()
    ]
    return [
        Text(
            "What the model saw grows older until the next VL row. The policy is given the age of "
            "the newest frame as `feature_age`."
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
    figure, axis = panels(8.5, 3.6)
    age_of = {"newest frame (feature_age)": ages.newest, **ages.by_view}
    finite = {name: age[np.isfinite(age)] for name, age in age_of.items()}
    low = min(0.0, *(float(age.min()) for age in finite.values() if len(age)))
    high = max(low + 1e-3, *(float(age.max()) for age in finite.values() if len(age)))
    edges = np.linspace(low, high, _BINS + 1)
    for number, (name, age) in enumerate(finite.items()):
        shares = np.histogram(age, edges)[0] * (100 / max(1, len(age)))
        style: dict[str, Any] = {"lw": 1.6} if number else {"fill": True, "alpha": 0.55}
        axis.stairs(shares, edges, color=PALETTE[number % len(PALETTE)], label=name, **style)
    if np.isfinite(ages.period_s):
        axis.axvline(ages.period_s, color=INK, ls="--", lw=1.2, label="one VL row")
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
            span = time[ahead[[0, -1]]] - time[0]
            kind = "frames from the future"
            yield episode.issue(kind, "vl/frame_time", text, *span, severity="error")
        if len(old):
            text = f"{len(old)} of {len(age)} ticks see features up to {age.max():.2f} s old; "
            text += f"expected less than {limit:.2f} s, the time of {_STALE_PERIODS} VL rows"
            span = time[old[[0, -1]]] - time[0]
            yield episode.issue("old frames", "vl/frame_time", text, *span)
