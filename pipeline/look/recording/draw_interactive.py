"""The clocks of an episode in a picture that can be zoomed and hovered.

It has no title and no colour of text: the page around it has both.
"""

import html
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from pipeline.look.page.style import PALETTE
from pipeline.look.recording.clocks import usual_step
from pipeline.look.recording.draw_lanes import BAND, LANE_COLOURS, in_reading_order
from pipeline.look.recording.draw_thinning import evenness, worst_steps
from pipeline.look.recording.facts import Clock, EpisodeView

SINGLE = 4000
"""Entries of a lane that are marks of their own; of a clock with more, every so many are."""
BINS = 1500
"""Of a lane of readings, which come too close for marks."""
_AXIS = "#888888"
"""Of axes and grid: seen on white and on black."""
_TICK = "#888888"
_SMALL = '<span style="font-size:12px">{}</span>'
_GAP = PALETTE[5]
_COLOURS = LANE_COLOURS | {"tick": _TICK}


def clock_lanes(view: EpisodeView, clocks: Sequence[Clock]) -> go.Figure:
    """A lane a clock: frames, VL rows and ticks as marks, readings as how even they come.

    Hovering tells time and index, of a VL row also which frame of each view it took and how old
    that was, of a tick the VL row that it reuses. Lines lead from frames to VL rows.
    """
    shown = [replace(clock, name=plain(clock.name)) for clock in in_reading_order(clocks)]
    figure = go.Figure(layout=layout())
    lanes = {clock.name: len(shown) - 1 - index for index, clock in enumerate(shown)}
    _served(figure, view, lanes)
    labels: dict[int, str] = {}
    for clock in shown:
        lane = lanes[clock.name]
        if clock.kind == "stream":
            _evenness(figure, clock, lane, view.zero)
            labels[lane] = clock.name
        else:
            step = -(-len(clock.time) // SINGLE)
            _marks(figure, view, clock, lane, step)
            labels[lane] = clock.name if step == 1 else f"{clock.name}, 1 of {step}"
        _gaps(figure, clock, lane, view.zero)
    figure.update_yaxes(
        tickvals=sorted(labels),
        ticktext=[labels[lane] for lane in sorted(labels)],
        range=[-0.7, len(shown) - 0.3],
        fixedrange=True,
        showgrid=False,
    )
    figure.update_xaxes(title=f"time since the recording began [s]<br>{_SMALL.format(BAND)}")
    figure.update_layout(height=110 + 46 * max(len(shown), 2), showlegend=False)
    return figure


def layout() -> dict[str, Any]:
    """Of every chart: axes that are seen on white and on black, and no background."""
    axis = {
        "gridcolor": "rgba(136, 136, 136, 0.3)",
        "linecolor": _AXIS,
        "zeroline": False,
        "automargin": True,
    }
    return {
        "template": "none",
        "paper_bgcolor": "rgba(0, 0, 0, 0)",
        "plot_bgcolor": "rgba(0, 0, 0, 0)",
        "margin": {"l": 10, "r": 10, "t": 10, "b": 45},
        "xaxis": axis,
        "yaxis": axis,
        "dragmode": "pan",
        "hovermode": "closest",
    }


def _marks(figure: go.Figure, view: EpisodeView, clock: Clock, lane: int, step: int) -> None:
    chosen = np.arange(0, len(clock.time), step)
    time = clock.time[chosen] - view.zero
    figure.add_trace(
        go.Scatter(
            x=time,
            y=np.full(len(time), lane),
            mode="markers",
            name=clock.name,
            marker={
                "symbol": "line-ns",
                "size": 22,
                "line": {"width": 2, "color": _COLOURS[clock.kind]},
            },
            text=_told(view, clock, chosen),
            hovertemplate="%{text}<br>%{x:.3f} s<extra></extra>",
        )
    )


def _told(view: EpisodeView, clock: Clock, chosen: NDArray[np.int64]) -> list[str]:
    """What hovering says of each of these entries of a clock."""
    line = view.timeline
    if clock.kind == "tick" and line is not None:
        first = np.searchsorted(line.vl_row, line.vl_row)
        return [
            f"tick {tick}, reuses VL row {line.vl_row[tick]}, ticks since: {tick - first[tick]}"
            for tick in chosen.tolist()
        ]
    if clock.kind == "vl_row" and line is not None:
        return [
            "<br>".join(
                [
                    f"VL row {row}",
                    *(
                        f"{plain(name)}: frame {line.frames[name][row]}, "
                        f"{1000 * (line.vl_time[row] - time[row]):.0f} ms old"
                        for name, time in line.frame_time.items()
                    ),
                ]
            )
            for row in chosen.tolist()
        ]
    return [f"{clock.name}, frame {index}" for index in chosen.tolist()]


def plain(name: str) -> str:
    """A recording's name for plotly, which reads texts as HTML."""
    return html.escape(name, quote=False)


def _served(figure: go.Figure, view: EpisodeView, lanes: dict[str, int]) -> None:
    """Lines from the frames to the VL rows that took them, of as many rows as are marked."""
    line = view.timeline
    if line is None or "VL rows" not in lanes:
        return
    rows = slice(None, None, -(-len(line.vl_time) // SINGLE) or 1)
    for view_name, time in line.frame_time.items():
        name = plain(view_name)
        if name not in lanes:
            continue
        # A NaN after each pair ends its line.
        ends = np.full((len(line.vl_time[rows]), 3), np.nan)
        ends[:, 0], ends[:, 1] = time[rows] - view.zero, line.vl_time[rows] - view.zero
        heights = np.tile([lanes[name], lanes["VL rows"], np.nan], (len(ends), 1))
        figure.add_trace(
            go.Scatter(
                x=ends.ravel(),
                y=heights.ravel(),
                mode="lines",
                name=f"frames of {name} that VL rows took",
                line={"width": 1, "color": _COLOURS["vl_row"]},
                opacity=0.6,
                hoverinfo="skip",
            )
        )


def _evenness(figure: go.Figure, clock: Clock, lane: int, zero: float) -> None:
    """Bars as high as the usual step over the longest one there; hovering tells that one."""
    bins = min(BINS, len(clock.time))
    edges = np.linspace(clock.time[0], max(clock.time[-1], clock.time[0] + 1e-3), bins + 1)
    longest = worst_steps(clock.time, edges)
    longest[~np.isfinite(longest)] = 0.0
    usual = usual_step(clock.time)
    heights = 0.7 * evenness(clock.time, edges)
    figure.add_trace(
        go.Bar(
            x=(edges[:-1] + edges[1:]) / 2 - zero,
            y=heights,
            base=lane - 0.35,
            width=np.diff(edges),
            name=clock.name,
            marker={"color": _COLOURS["stream"], "line": {"width": 0}},
            customdata=1000 * longest,
            hovertemplate=(
                f"{clock.name}, usual step {1000 * usual:.3g} ms<br>"
                "longest here %{customdata:.3g} ms<br>%{x:.3f} s<extra></extra>"
            ),
        )
    )


def _gaps(figure: go.Figure, clock: Clock, lane: int, zero: float) -> None:
    if not clock.gaps:
        return
    ends = np.array([(gap.start_s, gap.stop_s, np.nan) for gap in clock.gaps]) - zero
    lengths = np.repeat([gap.stop_s - gap.start_s for gap in clock.gaps], 3)
    figure.add_trace(
        go.Scatter(
            x=ends.ravel(),
            y=np.full(ends.size, lane),
            mode="lines+markers",
            name=f"gaps of {clock.name}",
            line={"width": 5, "color": _GAP},
            marker={"size": 8, "color": _GAP},
            customdata=lengths,
            hovertemplate=f"{clock.name}: gap of %{{customdata:.3g}} s<extra></extra>",
        )
    )
