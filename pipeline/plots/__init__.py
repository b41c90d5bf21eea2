"""Figures of merit -> pictures; the same numbers give the same bytes.

Those of a probe, of recordings and of stores are in modules apart from these: they know other
rooms.
"""

from pipeline.plots.chunks import chunks
from pipeline.plots.curves import curves
from pipeline.plots.errors import dimension_horizon, dimensions
from pipeline.plots.experiments import comparison_of_experiments
from pipeline.plots.modalities import modalities
from pipeline.plots.predictions import EPISODE_LINES, episodes, horizon, scatter, timeline
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
