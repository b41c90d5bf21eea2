"""What each episode of a store has, and how old its features are at every tick."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.store import Episode, FeatureStore, episode_name

_BLOCK_TICKS = 65536


@dataclass(frozen=True)
class EpisodeCoverage:
    """One episode: how long it is, and which streams it has for how much of it."""

    index: int
    name: str
    """`source/id`."""
    id: str
    source: str
    format: str
    instruction: str
    ticks: int
    vl_rows: int
    seconds: float
    """From the first tick to the last."""
    readings: Mapping[str, int]
    """`sensor` and `state` -> readings."""
    covered: Mapping[str, float]
    """`sensor`, `state`, and each view -> share of the episode's ticks that see it, 0 to 1."""


@dataclass(frozen=True, eq=False)
class Ages:
    """How old the features are at each tick: time of the tick less capture time of the frame."""

    newest: NDArray[np.float32]
    """(tick,) s since the newest frame, as `FeatureStore.feature_age` says."""
    by_view: NDArray[np.float32]
    """(tick, view) s since the frame of each view; NaN where the view is missing."""
    views: tuple[str, ...]
    period_s: float
    """Time from one VL row to the next: `vlm_reuse_count` median steps of the ticks; NaN where no
    episode has two ticks."""


def coverage(store: FeatureStore) -> tuple[EpisodeCoverage, ...]:
    """Every episode, in the order of the store."""
    return tuple(_covered(store, one) for one in store.episodes)


def ages(store: FeatureStore) -> Ages:
    """Of all ticks, in blocks; neither features nor readings are read."""
    views = tuple(store.streams["views"])
    newest = np.empty(store.ticks, np.float32)
    by_view = np.empty((store.ticks, len(views)), np.float32)
    time, row_of = store.array("tick/time"), store.array("tick/vl_row")
    shown = store.array("vl/frame_time")
    for start in range(0, store.ticks, _BLOCK_TICKS):
        ticks = np.arange(start, min(start + _BLOCK_TICKS, store.ticks))
        newest[ticks] = store.feature_age(ticks)
        by_view[ticks] = time[ticks, None] - shown[row_of[ticks]]
    return Ages(newest, by_view, views, store.vlm_reuse_count * store.tick_step())


def _covered(store: FeatureStore, episode: Episode) -> EpisodeCoverage:
    ticks = slice(episode.ticks.start, episode.ticks.stop)
    time = store.array("tick/time")[ticks]
    streams = {"sensor": episode.readings, "state": episode.states}
    covered = {
        name: _share(store.array(f"tick/{name}_end")[ticks] > rows.start)
        for name, rows in streams.items()
    }
    shown = np.isfinite(store.array("vl/frame_time")[store.array("tick/vl_row")[ticks]])
    for column, view in enumerate(store.streams["views"]):
        covered[view] = _share(shown[:, column])
    return EpisodeCoverage(
        index=episode.index,
        name=episode_name(episode),
        id=episode.id,
        source=episode.source,
        format=episode.format,
        instruction=episode.instruction,
        ticks=len(episode.ticks),
        vl_rows=len(episode.vl_rows),
        seconds=float(time[-1] - time[0]) if len(time) else 0.0,
        readings={name: len(rows) for name, rows in streams.items()},
        covered=covered,
    )


def _share(there: NDArray[np.bool_]) -> float:
    return float(there.mean()) if len(there) else 0.0
