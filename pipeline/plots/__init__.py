"""Figures of merit -> pictures; the same numbers give the same bytes.

The pictures of a probe are in `pipeline.plots.probe`, apart from these: they know another room.
"""

from pipeline.plots.experiments import comparison_of_experiments, write_experiments_plot
from pipeline.plots.modalities import modalities, write_modalities_plot
from pipeline.plots.predictions import (
    EPISODE_LINES,
    episodes,
    horizon,
    scatter,
    timeline,
    write_plots,
)
from pipeline.plots.style import LABELS

__all__ = [
    "EPISODE_LINES",
    "LABELS",
    "comparison_of_experiments",
    "episodes",
    "horizon",
    "modalities",
    "scatter",
    "timeline",
    "write_experiments_plot",
    "write_modalities_plot",
    "write_plots",
]
