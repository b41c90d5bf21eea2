"""What every picture shares: colours, fonts, and how it becomes a file.

The same numbers give the same bytes. Every way of acting keeps its colour, marker and line in all
pictures (Okabe and Ito's palette, which colour-blind readers can tell apart). What is neutral is
drawn in `INK` or `GRID` alone: a page exchanges them for its own colours, in light and in dark.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pipeline.durable import disk_full_named, fresh

LABELS = {
    "policy": "policy",
    "zero_action": "baseline: zero action",
    "mean_action": "baseline: mean training action",
    "repeat_last": "baseline: repeat the last action",
}
STYLES: dict[str, dict[str, Any]] = {
    "policy": {"color": "#0072B2", "marker": "o", "linestyle": "-", "zorder": 5},
    "zero_action": {"color": "#E69F00", "marker": "s", "linestyle": "--", "fillstyle": "none"},
    "mean_action": {"color": "#009E73", "marker": "^", "linestyle": "-."},
    "repeat_last": {"color": "#CC79A7", "marker": "D", "linestyle": ":"},
}
INK = "#333333"
"""Text, axes, and whatever else is black on white paper."""
GRID = "#dddddd"
"""Grid lines, and areas behind data."""
RECORDED = INK
PALETTE = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
"""Of what has no colour of its own; Okabe and Ito's, less what is lost on white or on black."""
RC: dict[Any, Any] = {
    "figure.constrained_layout.use": True,
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "hatch.color": INK,
    # Else the ids inside an SVG are drawn by chance.
    "svg.hashsalt": "pipeline",
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GRID,
    "axes.axisbelow": True,
    "legend.frameon": False,
}


def write(folder: Path, pictures: Mapping[str, Callable[[], Figure]]) -> list[Path]:
    """Draw each picture in the common style, save it by its name and return the paths.

    Raises `DiskFull`.
    """
    with mpl.rc_context(RC):
        for name, draw in pictures.items():
            figure = draw()
            # Without its `Software` entry the file does not change with matplotlib's version.
            with disk_full_named(folder):
                figure.savefig(fresh(folder / name), dpi=120, metadata={"Software": None})
    return [folder / name for name in pictures]


def canvas(width: float, height: float) -> Figure:
    """An empty picture of this size in inches, without a window."""
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    return figure


def legend_below(figure: Figure, axis: Axes, columns: int) -> None:
    """The legend of one axis, below all of them."""
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns)
