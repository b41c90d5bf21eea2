"""The picture of how evenly each clock ticks."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.look.page.style import INK, PALETTE, canvas, logarithmic
from pipeline.look.recording.draw_drawing import GAP, say, words
from pipeline.look.recording.draw_lanes import same_clock_once
from pipeline.look.recording.facts import Clock

_COLUMNS = 3
_BINS = 41
_SHOWN_DEVIATIONS, _LEAST_SHOWN = 10.0, 0.02
"""How far from the median a histogram goes: in median deviations, and at least, in medians."""


def clock_steps(clocks: Sequence[Clock]) -> Figure:
    """Histograms of the steps of each clock around its median, a panel a clock.

    What lies right or left of a panel, gaps among them, is counted at its edge.
    """
    shown = same_clock_once(clocks)
    if not shown:
        return words("The episode has no clock that could be read.")
    lines = math.ceil(len(shown) / _COLUMNS)
    figure = canvas(10.0, 1.9 * lines + 0.7)
    axes = figure.subplots(lines, min(_COLUMNS, len(shown)), squeeze=False).ravel()
    for axis in axes[len(shown) :]:
        axis.set_axis_off()
    for axis in axes[::_COLUMNS]:
        axis.set_ylabel("steps")
    for axis, clock in zip(axes, shown, strict=False):
        _histogram(axis, clock)
    _legend(figure, list(axes))
    return figure


def _legend(figure: Figure, axes: Sequence[Axes]) -> None:
    """What any panel shows, once each."""
    shown: dict[str, Artist] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            shown.setdefault(label, handle)
    if shown:
        figure.legend(list(shown.values()), list(shown), loc="outside lower center", ncols=3)


def _histogram(axis: Axes, clock: Clock) -> None:
    axis.set_title(clock.name, fontsize=10)
    steps = 1000 * np.diff(clock.time)
    if not len(steps):
        say(axis, f"{len(clock.time)} entry: no step")
        return
    median = float(np.median(steps))
    deviation = float(np.median(np.abs(steps - median)))
    reach = max(_SHOWN_DEVIATIONS * deviation, _LEAST_SHOWN * median, 1e-6)
    low, high = max(median - reach, 0.0), median + reach
    bins = np.linspace(low, high, _BINS + 1)
    inside = steps[(steps >= low) & (steps <= high)]
    axis.hist(inside, bins=bins.tolist(), color=PALETTE[0], label="steps")
    axis.axvline(median, color=INK, lw=1.2, ls="--", label="median")
    logarithmic(axis)
    axis.minorticks_off()
    axis.set_ylim(bottom=0.7)
    axis.set_xlim(low, high)
    axis.set_xlabel("step [ms]", fontsize=9)
    axis.ticklabel_format(axis="x", useOffset=False)
    _beyond(axis, steps[steps < low], low, "left")
    _beyond(axis, steps[steps > high], high, "right")


def _beyond(axis: Axes, steps: np.ndarray, edge: float, side: str) -> None:
    """How many steps the panel has no room for, at the edge beyond which they lie."""
    if not len(steps):
        return
    axis.plot(
        [edge], [0.75], marker="<" if side == "left" else ">", ms=8, color=GAP, ls="",
        clip_on=False, transform=axis.get_xaxis_transform(), label="steps beyond the panel",
    )  # fmt: skip
    extreme = steps.min() if side == "left" else steps.max()
    said = f"{len(steps)}, {'down' if side == 'left' else 'up'} to {extreme:.4g} ms "
    axis.text(edge, 0.85, said, ha=side, va="bottom", size=8, transform=axis.get_xaxis_transform())
