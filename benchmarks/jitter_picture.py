"""The picture of how a robot's loop keeps its deadlines."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from pipeline.look.page.style import INK, PALETTE, finish, panels
from pipeline.robot.run_report import Timings

_SLICES = 240
"""Parts of a run of which the latest tick is drawn."""


def jitter(runs: Mapping[str, tuple[float, Timings]]) -> Figure:
    """How late ticks begin and how long they take, a row for each run by name.

    `runs` has the rate in Hz and the timings of ticks, whose first part is how late each began and
    whose last is the whole tick. On the left the share of ticks that took more than so many ms, by
    part; on the right how late the latest tick of each moment began, and how long the longest took.
    """
    figure, axes = panels(11, 1.2 + 2.3 * len(runs), len(runs), 2, squeeze=False, sharex="col")
    for (name, (hz, timings)), (shares, course) in zip(runs.items(), axes, strict=True):
        rows = timings.rows()
        for column, (part, style) in enumerate(zip(timings.parts, _styles(timings), strict=True)):
            if len(rows):
                shares.ecdf(rows[:, column], complementary=True, lw=1.4, label=part, **style)
        shares.set(xscale="log", yscale="log")
        for scale in (shares.xaxis, shares.yaxis):
            # Plain numbers: matplotlib's own labels are TeX.
            scale.set_major_formatter(StrMethodFormatter("{x:g}"))
            scale.set_minor_formatter(NullFormatter())
        shares.set(title=f"{name}: share of ticks above", xlim=(0.01, None), ylim=(None, 1))
        minutes = np.arange(len(rows)) / hz / 60
        for column, part in ((0, "late"), (-1, "tick")):
            style = _styles(timings)[column]
            course.plot(*worst(minutes, rows[:, column]), lw=1, label=part, **style)
        course.set(title=f"{name}: latest and longest [ms]", ylim=(0, None))
        for axis, draw in ((shares, shares.axvline), (course, course.axhline)):
            draw(1000 / hz, color=INK, lw=0.8, ls="--")
            axis.grid(visible=True)
    axes[-1][0].set_xlabel("[ms] (dashed: a whole tick)")
    axes[-1][1].set_xlabel("time in the run [min]")
    finish(figure, axes[0][0], 5)
    return figure


def worst(
    time: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """When each slice of the run begins, and its largest value."""
    if not len(values):
        return time, values
    starts = np.unique(np.linspace(0, len(values), _SLICES, endpoint=False).astype(int))
    return time[starts], np.maximum.reduceat(values, starts)


def _styles(timings: Timings) -> Sequence[Mapping[str, Any]]:
    """The lateness and the whole tick stand out; parts beyond the palette are dashed."""
    lines = [{"color": colour, "ls": ls} for ls in ("-", "--", ":") for colour in PALETTE[2:]]
    first, last = {"color": PALETTE[0], "ls": "-"}, {"color": PALETTE[1], "ls": "-"}
    return [first, *lines[: len(timings.parts) - 2], last]
