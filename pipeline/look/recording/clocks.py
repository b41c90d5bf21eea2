"""When each stream was sampled: rates, jitter and gaps, what looks wrong in them, and their lanes.

A step of `GAP_FACTOR` usual steps or more is a gap: one entry lost from a jittering clock (two
steps and the jitter) is no gap, two entries lost in a row are one.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline.base.config import Params
from pipeline.base.errors import Issue
from pipeline.base.text import Table
from pipeline.data.timeline import Timeline
from pipeline.look.page.blocks import Block
from pipeline.look.page.style import INK, PALETTE, panels
from pipeline.look.recording.episode import Draw, LoadedRecording

# A step of so many usual steps or more is a gap.
GAP_FACTOR = 2.5
# In a step of so many usual steps or more, a camera has lost a frame.
DROPPED_STEP = 1.5
# Least number of such steps, and the share of all steps that they must exceed. The frames for which
# there was time must exceed it too: jitter alone leaves no time, as it also makes steps shorter.
DROPPED, DROPPED_SHARE = 5, 0.05

# If the median step is below this share of the mean step, entries are stamped in bursts.
_BURSTS = 0.5
# Share of the rising steps that may be gaps and are left out of the mean.
_LONGEST = 0.02
# Seconds between ticks, for an episode with fewer than two ticks.
_TICK_S = 0.1
# Repeated times are an issue if more than this share of entries has the time of the one before.
REPEATED = 0.05
# Fewest steps for frames to be called dropped.
_FEWEST = 20

_GAP_COLOUR = "#D55E00"
# Colour of a stroke, in the order of the lanes: a lane is below those that feed it.
_KINDS = {"stream": PALETTE[4], "camera": PALETTE[0], "vl_row": PALETTE[2], "tick": INK}
# VL rows in the picture, and its seconds if there are none.
_ROWS, _SPAN_S = 5, 1.5
# How far the marks of a lane reach up and down.
_HALF = 0.36


class Gap(NamedTuple):
    """From the last entry before a gap to the first after it, in seconds."""

    start_s: float
    stop_s: float

    @property
    def length_s(self) -> float:
        """How long it is."""
        return self.stop_s - self.start_s


@dataclass(frozen=True)
class Clock:
    """When a stream was sampled: `time` (entry,) s.

    `name` is `view View1`, `sensor`, `state`, `poses`, `action`, `ticks` or `VL rows`.
    """

    name: str
    kind: Literal["camera", "stream", "tick", "vl_row"]
    time: NDArray[np.float64]

    @cached_property
    def step_s(self) -> float:
        """The usual step; NaN for fewer than two entries, 0 where times only repeat."""
        return _usual(self.time)[0]

    @cached_property
    def shortest_gap_s(self) -> float:
        """`GAP_FACTOR` times the longest usual step.

        Infinite for fewer than three entries, and where times only repeat.
        """
        longest = _usual(self.time)[1]
        return GAP_FACTOR * longest if len(self.time) > 2 and longest > 0 else float("inf")

    @cached_property
    def gaps(self) -> tuple[Gap, ...]:
        """The gaps, in order."""
        places = np.flatnonzero(np.diff(self.time) >= self.shortest_gap_s)
        return tuple(Gap(float(self.time[at]), float(self.time[at + 1])) for at in places)

    @property
    def rate_hz(self) -> float:
        """1 / the usual step; NaN for fewer than two entries."""
        return 1 / self.step_s if self.step_s > 0 else float("nan")

    @property
    def mean_rate_hz(self) -> float:
        """Steps a second from the first entry to the last, gaps included; NaN where none rises."""
        span = float(np.ptp(self.time)) if len(self.time) else 0.0
        return (len(self.time) - 1) / span if span > 0 else float("nan")

    @property
    def jitter_s(self) -> float:
        """Standard deviation of the steps without gaps; NaN for fewer than three entries."""
        small = np.diff(self.time)
        small = small[small < self.shortest_gap_s]
        return float(small.std()) if len(small) > 1 else float("nan")


def read_clocks(view: LoadedRecording) -> list[Clock]:
    """Every clock of the episode: cameras and streams, then ticks and VL rows."""
    clocks = [
        Clock(name, "camera" if name.startswith("view ") else "stream", time)
        for name, time in view.clocks.items()
    ]
    if view.timeline is not None:
        clocks.append(Clock("ticks", "tick", view.timeline.time))
        clocks.append(Clock("VL rows", "vl_row", view.timeline.vl_time))
    return clocks


def usual_step(time: NDArray[np.float64]) -> float:
    """The step of a clock in seconds, NaN for fewer than two entries.

    It is the median. If entries are stamped in bursts, with steps of zero and long ones, it is the
    mean without the longest 2 % of the rising steps, which may be gaps; 0 if times only repeat.
    """
    return _usual(time)[0]


def _usual(time: NDArray[np.float64]) -> tuple[float, float]:
    """The usual step, and the longest usual one."""
    steps = np.diff(time)
    if not len(steps):
        return float("nan"), float("nan")
    rising = np.sort(steps[steps > 0])
    if not len(rising):
        return 0.0, 0.0
    median = float(np.median(steps))
    kept = rising[: max(1, len(rising) - int(np.ceil(_LONGEST * len(rising))))]
    mean = float(kept.mean()) * len(rising) / len(steps)
    return (mean, float(kept[-1])) if median < _BURSTS * mean else (median, median)


def _merge_equal(clocks: Iterable[Clock]) -> list[Clock]:
    """The clocks; those with the very same times become one whose name lists theirs.

    So a gap in the rows of a LeRobot episode is one gap, not one for each view and stream.
    """
    alike: dict[bytes, list[Clock]] = {}
    for clock in clocks:
        alike.setdefault(clock.time.tobytes(), []).append(clock)
    return [replace(same[0], name=", ".join(c.name for c in same)) for same in alike.values()]


def find_clock_issues(view: LoadedRecording) -> Iterator[Issue]:
    """Issues of kind gap, repeated times and dropped frames.

    A gap shorter than a tick is no issue: no tick loses a reading by it.
    """
    recorded = [clock for clock in read_clocks(view) if clock.kind in ("camera", "stream")]
    for clock in _merge_equal(recorded):
        expected = f"expected one every {clock.step_s:.3g} s"
        for gap in clock.gaps:
            if gap.length_s > _tick_s(view):
                message = f"no entry for {gap.length_s:.2f} s, {expected}"
                yield view.issue("gap", clock.name, message, *gap)
        still = int(np.count_nonzero(np.diff(clock.time) == 0))
        if still > REPEATED * (len(clock.time) - 1):
            message = f"{still} of {len(clock.time)} entries have the time of the entry before"
            yield view.issue("repeated times", clock.name, message)
        if clock.kind == "camera":
            yield from _dropped(view, clock)


def _dropped(view: LoadedRecording, clock: Clock) -> Iterator[Issue]:
    """A camera that loses frames one by one; gaps are separate issues."""
    steps = np.diff(clock.time)
    small = steps < clock.shortest_gap_s
    begun, steps = clock.time[:-1][small], steps[small]
    # Between bursts of stamps, steps are long although no frame is missing.
    if len(steps) < _FEWEST or clock.step_s > float(np.median(steps)):
        return
    places = np.flatnonzero(steps >= DROPPED_STEP * clock.step_s)
    long, lost = len(places), float(steps.sum()) / clock.step_s - len(steps)
    if long < DROPPED or min(long, lost) <= DROPPED_SHARE * len(steps):
        return
    message = (
        f"{long} of {len(steps)} steps take at least {DROPPED_STEP:g} times the usual "
        f"{1e3 * clock.step_s:.0f} ms (up to {1e3 * steps.max():.0f} ms): there is time for "
        f"{lost:.0f} more frames; {len(steps) / steps.sum():.1f} Hz on average"
    )
    span = float(begun[places[0]]), float((begun + steps)[places[-1]])
    yield view.issue("dropped frames", clock.name, message, *span)


def _tick_s(view: LoadedRecording) -> float:
    line = view.timeline
    return _TICK_S if line is None or len(line.time) < 2 else usual_step(line.time)


def clock_blocks(view: LoadedRecording, draw: Draw, params: Params) -> list[Block]:
    """The lanes and a table of all clocks, including ticks and VL rows; empty without any."""
    clocks = read_clocks(view)
    if not clocks:
        return []
    caption = (
        "When each stream was sampled, around the first gap, if any (hatched). Lines lead from "
        "frames to the VL row that took them, and from there to the ticks that reuse it."
    )
    return [draw("clocks", caption, draw_lanes), clock_table(view, clocks)]


def clock_table(view: LoadedRecording, clocks: Sequence[Clock]) -> Table:
    """Rates, jitter and gaps by clock."""
    heads = ("clock", "entries", "first [s]", "last [s]")
    heads += ("usual rate [Hz]", "on average [Hz]", "jitter [ms]", "gaps")
    rows = [
        (
            *(clock.name, len(clock.time)),
            *(clock.time[at] - view.zero if len(clock.time) else None for at in (0, -1)),
            *(clock.rate_hz, clock.mean_rate_hz, 1000 * clock.jitter_s, len(clock.gaps)),
        )
        for clock in clocks
    ]
    caption = f"Gaps are steps of at least {GAP_FACTOR:g} usual ones; jitter is without them."
    return Table(heads, rows, caption)


def draw_lanes(view: LoadedRecording) -> Figure:
    """A lane for each clock, over about five VL rows.

    Lines lead from each frame to the VL row that took it, and from the row to the ticks that reuse
    it. Streams with exactly the same times share a lane.
    """
    recorded = [clock for clock in read_clocks(view) if len(clock.time)]
    streams = _merge_equal(clock for clock in recorded if clock.kind == "stream")
    clocks = [*streams, *(clock for clock in recorded if clock.kind != "stream")]
    clocks.sort(key=lambda clock: [*_KINDS].index(clock.kind))
    start, stop = _choose_span(view, clocks)
    figure, axis = panels(11.0, 0.46 * len(clocks) + 1.4)
    axis.set_xlim(start - view.zero, stop - view.zero)
    for lane, clock in enumerate(clocks):
        _draw_lane(axis, clock, lane, view.zero)
    axis.set_yticks(range(len(clocks)), [clock.name for clock in clocks])
    axis.set_ylim(len(clocks) - 0.2, -0.7)
    if view.timeline is not None:
        lanes = {clock.name: lane for lane, clock in enumerate(clocks)}
        _draw_reuse(axis, view.timeline, view.zero, lanes, (start, stop))
    axis.set_xlabel("time since the recording began [s]")
    return figure


def _choose_span(view: LoadedRecording, clocks: Sequence[Clock]) -> tuple[float, float]:
    """Start and stop in s of the picture: five VL rows, around the first gap if any."""
    start = min(float(clock.time[0]) for clock in clocks)
    stop = max(float(clock.time[-1]) for clock in clocks)
    line = view.timeline
    step = float("nan") if line is None else usual_step(line.vl_time)
    width = min(_ROWS * step if step > 0 else _SPAN_S, max(stop - start, 1e-3))
    gaps = [gap.start_s - width / 4 for clock in clocks for gap in clock.gaps]
    begin = max(min([*gaps, (start + stop - width) / 2][0], stop - width), start)
    return begin, begin + width


def _draw_lane(axis: Axes, clock: Clock, lane: int, zero: float) -> None:
    """Draw a stroke for each entry, and the gaps."""
    low, high = axis.get_xlim()
    time = clock.time[(clock.time >= low + zero) & (clock.time <= high + zero)] - zero
    axis.vlines(time, lane - _HALF, lane + _HALF, colors=_KINDS[clock.kind], lw=1.0)
    spans = [(gap.start_s - zero, gap.length_s) for gap in clock.gaps]
    axis.broken_barh(
        spans, (lane - _HALF, 2 * _HALF), facecolor="none", hatch="////", lw=1.4,
        edgecolor=_GAP_COLOUR, hatchcolor=_GAP_COLOUR,
    )  # fmt: skip


def _draw_reuse(
    axis: Axes, line: Timeline, zero: float, lanes: Mapping[str, int], span: tuple[float, float]
) -> None:
    """Draw lines from frames to the VL rows that took them, and from these to their ticks."""
    ticks = np.flatnonzero((line.time >= span[0]) & (line.vl_time[line.vl_row] <= span[1]))
    rows, row_lane = np.unique(line.vl_row[ticks]), lanes["VL rows"]
    for name, time in line.frame_time.items():
        lane = lanes[f"view {name}"]
        _connect(axis, time[rows] - zero, lane, line.vl_time[rows] - zero, row_lane - _HALF)
        axis.plot(time[rows] - zero, [lane] * len(rows), "o", ms=5, color=_KINDS["vl_row"])
    begin, end = line.vl_time[line.vl_row[ticks]] - zero, line.time[ticks] - zero
    _connect(axis, begin, row_lane + _HALF, end, lanes["ticks"] - _HALF)


def _connect(
    axis: Axes, start: NDArray[Any], start_lane: float, stop: NDArray[Any], stop_lane: float
) -> None:
    ends = [[(a, start_lane), (b, stop_lane)] for a, b in zip(start, stop, strict=True)]
    axis.add_collection(LineCollection(ends, colors=_KINDS["vl_row"]))
