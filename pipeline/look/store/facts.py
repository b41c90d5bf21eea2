"""What a store holds and what of it looks wrong, as plain data.

`inspect_store` reads it through `FeatureStore` in bounded memory, whatever its size: whole only
what is a few bytes a tick or VL row, evenly spread samples of all that is wide.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.config import InspectParams
from pipeline.base.issue import Issue as Flaw
from pipeline.look.store.coverage import Ages, EpisodeCoverage, ages, coverage
from pipeline.look.store.duplicates import Duplicates, Still, Twins, find_duplicates
from pipeline.look.store.feature_flaws import broken_rows, feature_flaws
from pipeline.look.store.features import (
    Outlier,
    SampledRows,
    SlotNorms,
    look_at_features,
    outliers,
    sample_rows,
    slot_names,
)
from pipeline.look.store.flaws import episode_flaws
from pipeline.look.store.integrity import check_rows, open_checked
from pipeline.look.store.projection import StoreProjection, project
from pipeline.look.store.sizes import METADATA, ArraySize, array_sizes
from pipeline.look.store.statistics import StreamStatistics, stream_statistics

__all__ = [
    "METADATA",
    "Ages",
    "ArraySize",
    "Duplicates",
    "EpisodeCoverage",
    "Outlier",
    "SampledRows",
    "SlotNorms",
    "Still",
    "StoreProjection",
    "StoreView",
    "StreamStatistics",
    "Twins",
    "inspect_store",
]


@dataclass(frozen=True, eq=False)
class StoreView:
    """A store as one looks at it.

    Times of flaws, rows and pairs are seconds since the first tick of their episode.
    """

    path: Path
    spec: Mapping[str, Any]
    """The feature spec: the whole document and its digest."""
    streams: Mapping[str, Any]
    """Names and units of each stream's channels, and the views."""
    sources: tuple[str, ...]
    action_hz: float | None
    vlm_reuse_count: int
    variants: int
    """Views of each VL row; all that is said of features is of the plain frames."""
    environments: tuple[Mapping[str, Any], ...]
    """With what its VL rows were computed: `rows` [start, stop) and versions."""
    episodes: tuple[EpisodeCoverage, ...]
    ages: Ages
    sizes: tuple[ArraySize, ...]
    sampled: SampledRows
    """The VL rows that norms, projection and duplicates are of."""
    norms: SlotNorms
    outliers: tuple[Outlier, ...]
    projection: StoreProjection
    duplicates: Duplicates
    statistics: tuple[StreamStatistics, ...]
    flaws: tuple[Flaw, ...]
    """Errors first; one of the whole store names no episode."""

    @property
    def ticks(self) -> int:
        """Of all episodes."""
        return sum(one.ticks for one in self.episodes)

    @property
    def seconds(self) -> float:
        """Of all episodes, from first to last tick of each."""
        return sum(one.seconds for one in self.episodes)

    @property
    def disk_bytes(self) -> int:
        """Of all files."""
        return sum(one.disk_bytes for one in self.sizes)


def inspect_store(path: str | Path, params: InspectParams) -> StoreView:
    """Everything that is said of a finished store; it is only read.

    `params.points` VL rows are looked at at most, which takes some 16 x points^2 bytes of memory,
    and `params.duplicate_similarity` is what near-duplicates are from. The checksums of these rows
    are checked, and those of metadata and of every narrow array; the rest is for stages.verify.

    Raises `StoreIncomplete` where it is not there, unfinished, damaged or without an episode,
    `StoreMismatch` where it is an archive or follows another schema, each saying what to run.
    """
    store = open_checked(Path(path))
    episodes, age = coverage(store), ages(store)
    looked_at = sample_rows(store, params.points)
    broken = check_rows(store, looked_at.rows)
    found = look_at_features(store, looked_at.but(np.asarray(broken.any(axis=1))))
    duplicates = find_duplicates(store, found, params.duplicate_similarity)
    statistics, far = stream_statistics(store), outliers(found)
    flaws = [
        *broken_rows(episodes, looked_at, broken, slot_names(store)),
        *episode_flaws(store, episodes, age, statistics),
        *feature_flaws(episodes, found, far, duplicates),
    ]
    return StoreView(
        path=store.path,
        spec=store.spec,
        streams=store.streams,
        sources=tuple(store.sources),
        action_hz=store.action_hz,
        vlm_reuse_count=store.vlm_reuse_count,
        variants=store.variants,
        environments=tuple(store.attrs["environment"]),
        episodes=episodes,
        ages=age,
        sizes=array_sizes(store.path),
        sampled=found.sampled,
        norms=found.norms,
        outliers=far,
        projection=project(store, found),
        duplicates=duplicates,
        statistics=statistics,
        flaws=tuple(sorted(flaws, key=lambda one: one.severity != "error")),
    )
