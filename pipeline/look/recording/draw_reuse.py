"""Which frames a VL row took, and which ticks reuse it."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from pipeline.data.timeline import Timeline
from pipeline.look.page.style import PALETTE
from pipeline.look.recording.facts import EpisodeView

_ROW_LABELS = 12
_TICK_LABELS = 60
_ROW = PALETTE[2]


def draw(
    axis: Axes, view: EpisodeView, lanes: Mapping[str, int], near: tuple[float, float]
) -> None:
    """Lines from frames to VL rows and brackets from VL rows to ticks, between two instants."""
    line = view.timeline
    assert line is not None
    served = [range(*_ticks(line, row)) for row in range(len(line.vl_time))]
    rows = [
        row
        for row, ticks in enumerate(served)
        if len(ticks) and line.time[ticks[-1]] >= near[0] and line.vl_time[row] <= near[1]
    ]
    _from_frames(axis, view, lanes, rows)
    for row in rows:
        _bracket(axis, line.time[served[row]] - view.zero, lanes["VL rows"], lanes["ticks"])
        inside = line.vl_time[row] >= near[0] and line.time[served[row][-1]] <= near[1]
        if len(rows) <= _ROW_LABELS and inside:
            axis.text(
                line.vl_time[row] - view.zero, lanes["VL rows"], f" row {row}{_age(line, row)}",
                color=_ROW, size=8, va="center", clip_on=True,
            )  # fmt: skip
    ticks = [tick for row in rows for tick in served[row]]
    for tick in ticks if len(ticks) <= _TICK_LABELS else ():
        since = tick - served[line.vl_row[tick]][0]
        place = (line.time[tick] - view.zero, lanes["ticks"] + 0.42)
        axis.text(*place, str(since), size=7, ha="center", va="top", clip_on=True)


def _ticks(line: Timeline, row: int) -> tuple[int, int]:
    first, stop = np.searchsorted(line.vl_row, (row, row + 1))
    return int(first), int(stop)


def _from_frames(axis: Axes, view: EpisodeView, lanes: Mapping[str, int], rows: list[int]) -> None:
    line = view.timeline
    assert line is not None
    for name, time in line.frame_time.items():
        if name not in lanes:
            continue
        ends = [
            [
                (time[row] - view.zero, lanes[name]),
                (line.vl_time[row] - view.zero, lanes["VL rows"] - 0.36),
            ]
            for row in rows
        ]
        axis.add_collection(
            LineCollection(ends, colors=_ROW, linewidths=1.0, alpha=0.9, label=f"took {name}")
        )
        axis.plot(
            time[rows] - view.zero, np.full(len(rows), lanes[name]), "o", ms=5, color=_ROW, zorder=4
        )


def _bracket(axis: Axes, time: np.ndarray, row_lane: int, tick_lane: int) -> None:
    """From the row down, and along the ticks that it serves."""
    high, low = row_lane + 0.36, tick_lane - 0.5
    across = [time[0], time[0], time[-1], time[-1]]
    axis.plot(across, [high, low, low, tick_lane - 0.36], color=_ROW, lw=1.6)


def _age(line: Timeline, row: int) -> str:
    """How old the newest of its frames is."""
    newest = [time[row] for time in line.frame_time.values()]
    if not newest:
        return ""
    return f", {1000 * (line.vl_time[row] - max(newest)):.0f} ms old"
