"""Figures of merit -> pictures; the same numbers give the same bytes.

Those of a probe, of recordings and of stores are in modules apart from these: they know other
rooms.
"""

from pipeline.look.evaluation.draw_ablation import modalities
from pipeline.look.evaluation.draw_chunks import chunks
from pipeline.look.evaluation.draw_curves import curves
from pipeline.look.evaluation.draw_errors import dimension_horizon, dimensions
from pipeline.look.evaluation.draw_experiments import comparison_of_experiments
from pipeline.look.evaluation.draw_predictions import (
    EPISODE_LINES,
    episodes,
    horizon,
    scatter,
    timeline,
)
from pipeline.look.page.style import LABELS

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
