"""The picture of all clocks of an episode: over its whole length, and a stretch from near."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from pipeline.look.page.style import GRID, INK, PALETTE, canvas
from pipeline.look.recording import draw_reuse as reuse
from pipeline.look.recording.clocks import equal_clocks, usual_step
from pipeline.look.recording.draw_drawing import GAP, words
from pipeline.look.recording.draw_thinning import evenness
from pipeline.look.recording.facts import Clock, EpisodeView

LANE_COLOURS = {"camera": PALETTE[0], "stream": PALETTE[4], "tick": INK, "vl_row": PALETTE[2]}
"""By kind of clock."""
_SINGLE, _SINGLE_NEAR = 400, 240
"""Entries that are still shown one by one: over the whole episode, and from near."""
_BINS = 500
_GAP: dict[str, Any] = {
    "facecolor": "none",
    "edgecolor": GAP,
    "hatchcolor": GAP,
    "hatch": "////",
    "lw": 1.4,
}
_GAP_LABELS = 8
"""Gaps of a lane whose length is written, the longest ones."""
_ROWS_ZOOMED = 5
_ZOOM_S, _LEAST_ZOOM_S = 1.5, 0.5
"""Of what is shown from near: without VL rows, and with rows that follow fast."""
_OVERVIEW = "the whole episode (grey: the stretch below)"
BAND = "band height: usual step / longest step there"
"""What is said where a lane's entries lie too close for marks."""
_HALF = 0.36
"""Of a lane: how far its marks reach up and down."""


def clock_lanes(view: EpisodeView, clocks: Sequence[Clock]) -> Figure:
    """A lane a clock: over the whole episode, and about five VL rows from near.

    From near, lines lead from each frame to the VL row that took it, and brackets from the row to
    the ticks that reuse it, numbered by how many ticks old it is for them. Streams that were
    sampled by one clock share a lane.
    """
    shown = in_reading_order(clocks)
    if not shown:
        return words("The episode has no clock that could be read.")
    near = zoom(view, shown)
    heights = [0.34 * len(shown) + 0.3, 0.46 * len(shown) + 0.5]
    figure = canvas(11.0, sum(heights) + 1.6)
    whole, detail = figure.subplots(2, 1, gridspec_kw={"height_ratios": heights})
    _overview(whole, shown, view.zero, near)
    _detail(detail, view, shown, near)
    _legend(figure, view)
    return figure


def same_clock_once(clocks: Sequence[Clock]) -> list[Clock]:
    """The clocks, streams with the very same times as one whose name lists theirs."""
    streams = [clock for clock in clocks if clock.kind == "stream"]
    names = {
        streams[same[0]].name: ", ".join(streams[at].name for at in same)
        for same in equal_clocks([clock.time for clock in streams])
    }
    return [
        clock if clock.kind != "stream" else replace(clock, name=names[clock.name])
        for clock in clocks
        if clock.kind != "stream" or clock.name in names
    ]


def zoom(view: EpisodeView, clocks: Sequence[Clock]) -> tuple[float, float]:
    """The stretch (start, stop) in s that is shown from near: five VL rows, around a gap if any.

    The first gap of a camera comes before those of other streams; without one, the middle.
    """
    line = view.timeline
    start = min(float(clock.time[0]) for clock in clocks)
    stop = max(float(clock.time[-1]) for clock in clocks)
    step = usual_step(line.vl_time) if line is not None else float("nan")
    width = max(_ROWS_ZOOMED * step, _LEAST_ZOOM_S) if step > 0 else _ZOOM_S
    by_kind = sorted(clocks, key=lambda clock: clock.kind != "camera")
    gaps = [gap for clock in by_kind for gap in clock.gaps]
    middle = (start + stop) / 2
    if gaps:
        # Of a gap longer than the stretch, where it begins.
        middle = min((gaps[0].start_s + gaps[0].stop_s) / 2, gaps[0].start_s + width / 4)
    begin = min(max(middle - width / 2, start), max(stop - width, start))
    if line is not None and len(line.vl_time):
        # From just before a row, so that it is seen with all of its ticks.
        row = max(int(np.searchsorted(line.vl_time, begin + width / 10, side="right")) - 1, 0)
        begin = min(max(float(line.vl_time[row]) - width / 10, start), max(stop - width, start))
    return begin, min(begin + width, max(stop, begin + 1e-3))


def in_reading_order(clocks: Sequence[Clock]) -> list[Clock]:
    """Those with an entry, once each: streams, cameras, VL rows, ticks.

    What feeds a lane stands above it.
    """
    order = ("stream", "camera", "vl_row", "tick")
    shown = [clock for clock in same_clock_once(clocks) if len(clock.time)]
    return sorted(shown, key=lambda clock: order.index(clock.kind))


def _overview(axis: Axes, clocks: Sequence[Clock], zero: float, near: tuple[float, float]) -> None:
    start = min(float(clock.time[0]) for clock in clocks) - zero
    stop = max(float(clock.time[-1]) for clock in clocks) - zero
    room = 0.01 * max(stop - start, 1e-3)
    axis.set_xlim(start - room, stop + room)
    axis.axvspan(near[0] - zero, near[1] - zero, color=GRID, lw=0, zorder=0.3)
    for lane, clock in enumerate(clocks):
        if len(clock.time) <= _SINGLE:
            marks(axis, clock.time - zero, lane, LANE_COLOURS[clock.kind])
        else:
            _evenness(axis, clock, lane, zero, (clock.time[0], clock.time[-1]))
        _gaps(axis, clock, lane, zero)
    axis.set_title(_OVERVIEW, loc="left", fontsize=10)
    _lanes(axis, [clock.name for clock in clocks])
    for lane, clock in enumerate(clocks):
        axis.annotate(
            _said(clock), (1.005, lane), xycoords=axis.get_yaxis_transform(), va="center", size=8
        )


def _detail(
    axis: Axes, view: EpisodeView, clocks: Sequence[Clock], near: tuple[float, float]
) -> None:
    start, stop = near
    axis.set_xlim(start - view.zero, stop - view.zero)
    lanes = {clock.name: lane for lane, clock in enumerate(clocks)}
    for lane, clock in enumerate(clocks):
        inside = clock.time[(clock.time >= start) & (clock.time <= stop)]
        if len(inside) <= _SINGLE_NEAR:
            marks(axis, inside - view.zero, lane, LANE_COLOURS[clock.kind], 1.6)
        else:
            _evenness(axis, clock, lane, view.zero, near)
        _gaps(axis, clock, lane, view.zero)
    _lanes(axis, [clock.name for clock in clocks])
    if view.timeline is not None and {"VL rows", "ticks"} <= set(lanes):
        reuse.draw(axis, view, lanes, near)
    axis.set_title(f"from near: {stop - start:.2f} s", loc="left", fontsize=10)
    axis.set_xlabel("time since the recording began [s]")


def marks(
    axis: Axes, time: NDArray[np.float64], lane: int, colour: str, width: float = 1.2
) -> None:
    """A vertical stroke an entry."""
    ends = np.empty((len(time), 2, 2))
    ends[:, :, 0] = time[:, None]
    ends[:, :, 1] = (lane - _HALF, lane + _HALF)
    axis.add_collection(LineCollection(list(ends), colors=colour, linewidths=width))


def _evenness(axis: Axes, clock: Clock, lane: int, zero: float, span: tuple[float, float]) -> None:
    """A band as high as the usual step over the longest one there: full where no entry is lost."""
    edges = np.linspace(*span, _BINS + 1)
    height = 2 * _HALF * evenness(clock.time, edges)
    axis.fill_between(
        np.repeat(edges - zero, 2)[1:-1],
        lane + _HALF,
        lane + _HALF - np.repeat(height, 2),
        color=LANE_COLOURS[clock.kind],
        lw=0,
        label=BAND,
    )


def _gaps(axis: Axes, clock: Clock, lane: int, zero: float) -> None:
    low, high = axis.get_xlim()
    ends = np.array([(gap.start_s, gap.stop_s) for gap in clock.gaps]).reshape(-1, 2) - zero
    ends = ends[(ends[:, 1] >= low) & (ends[:, 0] <= high)]
    boxes = np.empty((len(ends), 4, 2))
    boxes[:, :, 0] = ends[:, [0, 1, 1, 0]]
    boxes[:, :, 1] = lane + _HALF * np.array([-1, -1, 1, 1])
    # One for all: thousands of gaps as patches take many seconds.
    axis.add_collection(PolyCollection(list(boxes), zorder=3, **_GAP), autolim=False)
    for start, stop in ends[np.argsort(ends[:, 0] - ends[:, 1], kind="stable")[:_GAP_LABELS]]:
        axis.text(
            (max(start, low) + min(stop, high)) / 2, lane - _HALF, f"{stop - start:.2g} s",
            color=GAP, size=8, ha="center", va="bottom", clip_on=True,
        )  # fmt: skip


def _lanes(axis: Axes, names: Sequence[str]) -> None:
    axis.set_yticks(range(len(names)), names)
    axis.set_ylim(len(names) - 0.2, -0.7)
    axis.grid(axis="y", visible=False)
    axis.tick_params(axis="y", length=0)


def _said(clock: Clock) -> str:
    """Rate, jitter and count in one line."""
    if not np.isfinite(clock.rate_hz):
        return f"{len(clock.time):,}"
    known = np.isfinite(clock.jitter_s)
    # Below a microsecond it is the float's own rounding.
    jitter = f" ± {1000 * clock.jitter_s:.2g} ms" if known and clock.jitter_s > 1e-6 else ""
    return f"{clock.rate_hz:.4g} Hz{jitter}, {len(clock.time):,} entries"


def _legend(figure: Figure, view: EpisodeView) -> None:
    handles = [
        Patch(color=colour, label=label)
        for label, colour in (
            ("reading", LANE_COLOURS["stream"]),
            ("frame", LANE_COLOURS["camera"]),
            ("VL row, age of its newest frame; lines: the frames it took", LANE_COLOURS["vl_row"]),
            ("tick; number: ticks since its VL row", LANE_COLOURS["tick"]),
        )
    ]
    if view.timeline is None:
        handles = handles[:2]
    gap = Patch(**_GAP, label="gap")
    drawn = [one.get_label() for axis in figure.axes for one in axis.collections]
    said = BAND if BAND in drawn else None
    figure.legend(
        handles=[*handles, gap], loc="outside lower center", ncols=3, fontsize=8.5, title=said,
        title_fontsize=8.5,
    )  # fmt: skip
