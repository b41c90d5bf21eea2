"""Figures of merit -> pictures; the same numbers give the same bytes.

Those of a probe, of recordings and of stores are in modules apart from these: they know other
rooms.
"""

from pipeline.plots.evaluation.chunks import chunks
from pipeline.plots.evaluation.curves import curves
from pipeline.plots.evaluation.errors import dimension_horizon, dimensions
from pipeline.plots.evaluation.experiments import comparison_of_experiments
from pipeline.plots.evaluation.modalities import modalities
from pipeline.plots.evaluation.predictions import (
    EPISODE_LINES,
    episodes,
    horizon,
    scatter,
    timeline,
)
from pipeline.plots.style import LABELS

__all__ = [
    "EPISODE_LINES",
    "LABELS",
    "chunks",
    "comparison_of_experiments",
    "curves",
    "dimension_horizon",
    "dimensions",
    "episodes",
    "horizon",
    "modalities",
    "scatter",
    "timeline",
]
