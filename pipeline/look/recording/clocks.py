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
from pipeline.look.page.style import GRID, INK, PALETTE, panels
from pipeline.look.recording.episode import Draw, EpisodeView

# A step of so many usual steps or more is a gap.
GAP_FACTOR = 2.5
# In a step of so many usual steps or more, a camera has lost a frame.
DROPPED_STEP = 1.5
# Least number of such steps, and the share of all steps that they must exceed. The frames for which
# there was time must exceed it too: jitter alone leaves no time, as it also makes steps shorter.
DROPPED, DROPPED_SHARE = 5, 0.05
# How late a stream may begin, or how early end: the smaller of seconds and a share of the episode,
# but at least so many ticks and `DROPPED_STEP` of its own steps.
LOST_S, LOST_SHARE, LOST_TICKS = 0.5, 0.05, 2.5

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
# A lane has room for so many strokes: of entries that are nearer, only one is drawn.
_STROKES = 1500
# VL rows in the lower picture, and its seconds if there are none.
_ROWS_NEAR, _NEAR_S = 5, 1.5
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


def read_clocks(view: EpisodeView) -> list[Clock]:
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


def find_clock_issues(view: EpisodeView) -> Iterator[Issue]:
    """Issues of kind gap, repeated times, dropped frames and lost ticks.

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
    yield from _lost_ticks(view, recorded)


def _dropped(view: EpisodeView, clock: Clock) -> Iterator[Issue]:
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


def _lost_ticks(view: EpisodeView, recorded: Sequence[Clock]) -> Iterator[Issue]:
    """A stream that begins after most of the others or ends before most of them."""
    # A clock that was set during the recording has a gap, and cannot say when its stream ended.
    clocks = [c for c in recorded if all(gap.length_s < LOST_S for gap in c.gaps)]
    if len(clocks) < 2:
        return
    middle, tick_s = (len(clocks) - 1) // 2, _tick_s(view)
    least_s = max(LOST_TICKS * tick_s, min(LOST_S, LOST_SHARE * view.duration_s))
    for place, sign, words in ((0, 1, "begins {:.2f} s after"), (-1, -1, "ends {:.2f} s before")):
        # The later, the further into the episode, from its start or back from its stop.
        inward = [sign * float(clock.time[place]) for clock in clocks]
        extreme, usual = max(inward), sorted(inward)[middle]
        lost_s = extreme - usual
        near_s = min(LOST_S, lost_s) / 2
        late = [c for c, at in zip(clocks, inward, strict=True) if extreme - at <= near_s]
        if lost_s > max(least_s, *(DROPPED_STEP * clock.step_s for clock in late)):
            share = 100 * lost_s / view.duration_s
            cost = f"about {lost_s / tick_s:.0f} ticks, {share:.0f} % of the episode"
            message = f"{words.format(lost_s)} most others, which costs {cost}"
            names = ", ".join(clock.name for clock in late)
            span = sorted((sign * usual, sign * extreme))
            yield view.issue("lost ticks", names, message, *span)


def _tick_s(view: EpisodeView) -> float:
    line = view.timeline
    return _TICK_S if line is None or len(line.time) < 2 else usual_step(line.time)


def clock_blocks(view: EpisodeView, draw: Draw, params: Params) -> list[Block]:
    """The lanes and a table of all clocks, including ticks and VL rows; empty without any."""
    clocks = read_clocks(view)
    if not clocks:
        return []
    caption = (
        "When each stream was sampled; hatched boxes are gaps. Lines lead from frames to the VL "
        "row that took them, and from there to the ticks that reuse it."
    )
    return [draw("clocks", caption, draw_lanes), clock_table(view, clocks)]


def clock_table(view: EpisodeView, clocks: Sequence[Clock]) -> Table:
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


def draw_lanes(view: EpisodeView) -> Figure:
    """A lane for each clock: the whole episode above, about five VL rows below.

    In the lower picture, lines lead from each frame to the VL row that took it, and from the row to
    the ticks that reuse it. Streams with exactly the same times share a lane.
    """
    recorded = [clock for clock in read_clocks(view) if len(clock.time)]
    streams = _merge_equal(clock for clock in recorded if clock.kind == "stream")
    clocks = [*streams, *(clock for clock in recorded if clock.kind != "stream")]
    clocks.sort(key=lambda clock: [*_KINDS].index(clock.kind))
    start = min(float(clock.time[0]) for clock in clocks)
    stop = max(float(clock.time[-1]) for clock in clocks)
    near = _choose_near(view, clocks, start, stop)
    room = 0.01 * max(stop - start, 1e-3)
    heights = [0.34 * len(clocks) + 0.3, 0.46 * len(clocks) + 0.5]
    figure, (whole, detail) = panels(11.0, sum(heights) + 0.9, 2, 1, height_ratios=heights)
    for axis, span in ((whole, (start - room, stop + room)), (detail, near)):
        axis.set_xlim(span[0] - view.zero, span[1] - view.zero)
        for lane, clock in enumerate(clocks):
            _draw_lane(axis, clock, lane, view.zero)
        axis.set_yticks(range(len(clocks)), [clock.name for clock in clocks])
        axis.set_ylim(len(clocks) - 0.2, -0.7)
    whole.axvspan(near[0] - view.zero, near[1] - view.zero, color=GRID, lw=0, zorder=0.3)
    whole.set_title("the whole episode", loc="left", fontsize=10)
    if view.timeline is not None:
        lanes = {clock.name: lane for lane, clock in enumerate(clocks)}
        _draw_reuse(detail, view.timeline, view.zero, lanes, near)
    detail.set_title(f"the grey part: {near[1] - near[0]:.2f} s", loc="left", fontsize=10)
    detail.set_xlabel("time since the recording began [s]")
    return figure


def _choose_near(
    view: EpisodeView, clocks: Sequence[Clock], start: float, stop: float
) -> tuple[float, float]:
    """Start and stop in s of the lower picture: five VL rows, around the first gap if any."""
    line = view.timeline
    step = float("nan") if line is None else usual_step(line.vl_time)
    width = min(_ROWS_NEAR * step if step > 0 else _NEAR_S, max(stop - start, 1e-3))
    gaps = [gap.start_s - width / 4 for clock in clocks for gap in clock.gaps]
    begin = max(min([*gaps, (start + stop - width) / 2][0], stop - width), start)
    return begin, begin + width


def _draw_lane(axis: Axes, clock: Clock, lane: int, zero: float) -> None:
    """Draw a stroke for each entry, as far as there is room, and the gaps."""
    low, high = axis.get_xlim()
    time = clock.time[(clock.time >= low + zero) & (clock.time <= high + zero)] - zero
    places = ((time - low) / (high - low) * _STROKES).astype(np.int64)
    time = time[np.unique(places, return_index=True)[1]]
    axis.vlines(time, lane - _HALF, lane + _HALF, colors=_KINDS[clock.kind], lw=1.0)
    spans = [(gap.start_s - zero, gap.length_s) for gap in clock.gaps]
    # One artist for all: thousands of gaps as patches take many seconds.
    axis.broken_barh(
        spans, (lane - _HALF, 2 * _HALF), facecolor="none", hatch="////", lw=1.4,
        edgecolor=_GAP_COLOUR, hatchcolor=_GAP_COLOUR,
    )  # fmt: skip


def _draw_reuse(
    axis: Axes, line: Timeline, zero: float, lanes: Mapping[str, int], near: tuple[float, float]
) -> None:
    """Draw lines from frames to the VL rows that took them, and from these to their ticks."""
    ticks = np.flatnonzero((line.time >= near[0]) & (line.vl_time[line.vl_row] <= near[1]))
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
