"""Where a policy errs: by action dimension, and by how far ahead."""

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pipeline.evaluate.names import with_unit
from pipeline.look.evaluation.draw_predictions import marked
from pipeline.look.page.style import LABELS, canvas, legend_below
from pipeline.train.predictions import METHODS
from pipeline.train.scores import Comparison

_NUMBERED_STEPS = 16
"""Steps of a chunk up to which a cell has room for its number."""
_DARK, _LIGHT = "#111111", "#ffffff"
"""Ink on a coloured cell, which is the same in light and in dark."""


def dimensions(comparison: Comparison) -> Figure:
    """Mean absolute error of each dimension that varies, in units of its training deviation."""
    shown = comparison.varying()
    figure = canvas(9.0, 0.42 * len(shown) + 2.0)
    axis = figure.subplots()
    lines = np.arange(len(shown))
    for method in METHODS:
        errors = comparison.in_training_std(comparison.scores[method].mae)
        style: dict[str, Any] = marked(method) | {"linestyle": "", "label": LABELS[method]}
        axis.plot(errors, lines, **style)
    axis.set_yticks(lines, _names(comparison, shown))
    axis.set_ylim(len(shown) - 0.5, -0.5)
    axis.set_xlim(left=0)
    axis.set_xlabel("mean absolute error [training std] (left is better)")
    legend_below(figure, axis, 2)
    figure.suptitle("Error of each action dimension on held-out ticks")
    return figure


def dimension_horizon(comparison: Comparison) -> Figure:
    """The policy's error over dimensions and steps ahead, each in its training deviation."""
    shown = comparison.varying()
    errors = comparison.in_training_std(comparison.scores["policy"].mae_horizon).T
    steps = errors.shape[1]
    figure = canvas(9.0, 0.42 * len(shown) + 1.9)
    axis = figure.subplots()
    axis.grid(visible=False)
    worst = float(np.nanmax(errors)) or 1.0
    colours = mpl.colormaps["viridis_r"]
    image = axis.imshow(errors, colours, vmin=0, vmax=worst, aspect="auto", interpolation="nearest")
    bar = figure.colorbar(image, ax=axis, pad=0.02)
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    bar.set_label("error [training std]")
    if steps <= _NUMBERED_STEPS:
        for (row, step), error in np.ndenumerate(errors):
            if np.isfinite(error):
                ink = _LIGHT if error > 0.55 * worst else _DARK
                axis.text(step, row, f"{error:.2f}", ha="center", va="center", color=ink)
    axis.set_yticks(range(len(shown)), _names(comparison, shown))
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    axis.set_xlabel("steps ahead")
    figure.suptitle("Error of the policy by dimension and step of the chunk (light is better)")
    return figure


def _names(comparison: Comparison, dimensions: list[int]) -> list[str]:
    return [with_unit(comparison.names[i], comparison.units[i]) for i in dimensions]
