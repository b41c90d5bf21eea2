"""What the pictures of a recording share: curves of a group, hatched spans, and plain words."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline.look.page.style import INK, PALETTE, canvas

CONTACT = "#E69F00"
GAP = "#D55E00"
LINES = ("-", "--", ":")
ABSENT = "//"
"""Hatch of what is not there: padding, masked steps, missing streams."""


def words(said: str, width: float = 8.0) -> Figure:
    """A picture of one sentence, where there is nothing to draw."""
    figure = canvas(width, 0.8)
    axis = figure.subplots()
    say(axis, said)
    return figure


def say(axis: Axes, said: str) -> None:
    """One sentence in an otherwise empty panel."""
    axis.set_axis_off()
    axis.text(0.5, 0.5, said, ha="center", va="center", transform=axis.transAxes, wrap=True)


def centre(axis: Axes, said: str) -> None:
    """A few words in the middle of a panel."""
    axis.text(0.5, 0.5, said, ha="center", va="center", transform=axis.transAxes)


def colour(index: int) -> tuple[str, str]:
    """(colour, line) of the curve of this number; no two of the first 18 are the same."""
    return PALETTE[index % len(PALETTE)], LINES[index // len(PALETTE) % len(LINES)]


def curves(
    axis: Axes,
    time: NDArray[np.float64],
    values: NDArray[np.floating],
    labels: Sequence[str],
    steps: bool = False,
) -> None:
    """Values (point, channel) as one curve a channel; `steps` holds each until the next."""
    style = "steps-post" if steps else "default"
    # A single reading makes no line.
    marker = "." if len(time) == 1 else None
    for index, label in enumerate(labels):
        ink, line = colour(index)
        axis.plot(
            time,
            values[:, index],
            color=ink,
            ls=line,
            lw=1.3,
            # A label that begins with an underscore would drop out of the legend.
            label=f" {label}" if label.startswith("_") else label,
            drawstyle=style,
            marker=marker,
        )


def legend_beside(axis: Axes, of: Axes | None = None, fontsize: float = 8) -> None:
    """The legend of a panel, or of another one, right of it; in columns where it is long."""
    handles, labels = (of or axis).get_legend_handles_labels()
    axis.legend(
        handles,
        labels,
        loc="center left",
        bbox_to_anchor=(1.005, 0.5),
        fontsize=fontsize,
        ncols=1 + len(labels) // 8,
        handlelength=1.6,
    )


def absent(axis: Axes, start: float, stop: float) -> None:
    """A hatched span: what lies there was not recorded."""
    axis.axvspan(
        start, stop, facecolor="none", edgecolor=INK, hatch=ABSENT, lw=0, alpha=0.35, zorder=0.5
    )
