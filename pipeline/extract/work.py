"""What is left to be computed, and what came of it, whoever computes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import Params
from pipeline.base.digests import ContentDigests
from pipeline.data import Recording
from pipeline.store import RowSource, StoreBuild
from pipeline.vlm.feature_spec import FeatureSpec


@dataclass(frozen=True)
class Work:
    """Feature rows that a laid-out build lacks."""

    build: StoreBuild
    spec: FeatureSpec
    recordings: Sequence[Recording]
    """Of each episode of the build."""
    vl_start: NDArray[np.int64]
    """(episode + 1,) where the rows of each begin."""
    frame_time: NDArray[np.float64]
    """(row, view)"""
    missing: NDArray[np.int64]
    """Rows to compute, ascending."""
    donors: Sequence[RowSource]
    """Of the same feature spec: a row of known key is copied."""
    params: Params
    digests: ContentDigests
    done: Callable[[int], object]
    """Told how many rows each commit brought."""


@dataclass(frozen=True)
class Computed:
    """What came of the rows that no donor had by their frames."""

    computed: int = 0
    known: int = 0
    """Rows that a donor turned out to have once their frames were decoded."""
    repeated: int = 0
    """Rows equal to another that was computed."""
    rows_per_s: float | None = None
    """Rows computed once the model was there; None where they were too few to tell."""
    model_share: float | None = None
    """Of the time since the model was loaded, how much it worked; None where none was, here."""
    waited_share: float | None = None
    """Likewise, how much it waited for frames to be decoded and prepared."""
