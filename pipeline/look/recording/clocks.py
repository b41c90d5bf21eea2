"""When everything was sampled: rates, jitter and gaps, what looks wrong in them, and their lanes.

A step is a gap from `GAP_FACTOR` usual steps: one entry lost from a jittering clock (two steps and
the jitter) is none, two lost in a row are.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline.base.config import Params
from pipeline.base.issue import Issue
from pipeline.base.source import RATE_TOLERANCE
from pipeline.base.table import Table
from pipeline.data.recording import Nominal
from pipeline.data.timeline import Timeline
from pipeline.look.page.blocks import Block
from pipeline.look.page.style import GRID, INK, PALETTE, panels
from pipeline.look.recording.episode import Draw, EpisodeView

# Usual steps from which a step is a gap.
GAP_FACTOR = 2.5
# Usual steps from which a camera's step has lost a frame.
DROPPED_STEP = 1.5
# How many such steps there are at least, and what share of the steps they have to exceed, as have
# the frames that there was time for: jitter alone leaves no time, as steps get shorter too.
DROPPED, DROPPED_SHARE = 5, 0.05
# By how much a stream may begin after the others, or end before them: in seconds, or as a share of
# a short episode, there by so many ticks and `DROPPED_STEP` of its own steps in any case.
LOST_S, LOST_SHARE, LOST_TICKS = 0.5, 0.05, 2.5
# Share of entries that may have the time of the entry before.
REPEATED = 0.05
# Times the span that a VL row serves which its frames may usually be old.
OLD = 2.0

# Share of the mean step under which a median step means stamps in bursts.
_BURSTS = 0.5
# Share of the rising steps that may be gaps and are left out of the mean.
_LONGEST = 0.02
# Seconds between the ticks of an episode without two.
_TICK_S = 0.1
# Steps below which nothing is said of how a clock runs.
_FEWEST = 20


class Span(NamedTuple):
    """Where a clock skipped: from the last entry before to the first after, in seconds."""

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
        """From how long on a step is a gap: `GAP_FACTOR` times the longest step that is usual.

        Infinite for fewer than three entries, and where times only repeat: no step is usual there.
        """
        longest = _usual(self.time)[1]
        return GAP_FACTOR * longest if len(self.time) > 2 and longest > 0 else float("inf")

    @cached_property
    def gaps(self) -> tuple[Span, ...]:
        """Where it skips, in order."""
        places = np.flatnonzero(np.diff(self.time) >= self.shortest_gap_s)
        return tuple(Span(float(self.time[at]), float(self.time[at + 1])) for at in places)

    @property
    def rate_hz(self) -> float:
        """1 / the usual step; NaN for fewer than two entries."""
        return 1 / self.step_s if self.step_s > 0 else float("nan")

    @property
    def mean_rate_hz(self) -> float:
        """Steps a second from the first entry to the last, gaps and all; NaN where none rises."""
        span = float(np.ptp(self.time)) if len(self.time) else 0.0
        return (len(self.time) - 1) / span if span > 0 else float("nan")

    @property
    def jitter_s(self) -> float:
        """Standard deviation of the steps that are no gaps; NaN for fewer than three entries."""
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


def merge_equal(clocks: Iterable[Clock]) -> list[Clock]:
    """The clocks, those with the very same times as one whose name lists theirs.

    So a gap in the rows of a LeRobot episode is one gap and not one of each view and stream.
    """
    alike: dict[bytes, list[Clock]] = {}
    for clock in clocks:
        alike.setdefault(clock.time.tobytes(), []).append(clock)
    return [replace(same[0], name=", ".join(c.name for c in same)) for same in alike.values()]


def usual_step(time: NDArray[np.float64]) -> float:
    """The step of a clock in seconds, NaN for fewer than two entries.

    The median; where entries are stamped in bursts, which have steps of nothing and long ones, the
    mean without the longest 2 % of the rising steps, which may be gaps; 0 where times only repeat.
    """
    return _usual(time)[0]


def find_clock_issues(view: EpisodeView, nominal: Nominal) -> Iterator[Issue]:
    """Issues of kind gap, clock jump, repeated times, rate, dropped frames, lost ticks and old
    frames; `nominal` is what the recording says of itself.

    A gap shorter than the ticks are apart is none: no tick sees less by it.
    """
    recorded = [clock for clock in read_clocks(view) if clock.kind in ("camera", "stream")]
    for clock in merge_equal(recorded):
        expected = [nominal.rates_hz[n] for n in clock.name.split(", ") if n in nominal.rates_hz]
        yield from _gaps(view, clock, _find_jumps(clock, recorded))
        yield from _repeated(view, clock)
        if clock.kind == "camera":
            yield from _dropped(view, clock)
        if expected and len(clock.time) > 2:
            yield from _rate(view, clock, expected[0], nominal.where)
    if len(recorded) > 1:
        yield from _lost_ticks(view, recorded)
    yield from _old_frames(view)


def _usual(time: NDArray[np.float64]) -> tuple[float, float]:
    """The usual step, and the longest that is usual."""
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


def _gaps(view: EpisodeView, clock: Clock, jumps: Mapping[Span, str]) -> Iterator[Issue]:
    line, camera = view.timeline, clock.name.split(", ")[0].removeprefix("view ")
    for gap in clock.gaps:
        if gap.length_s <= _tick_s(view):
            continue
        kind, step = "gap", clock.step_s
        message = f"no entry for {gap.length_s:.2f} s, expected one every {step:.3g} s"
        if gap in jumps:
            kind, since = "clock jump", f"{gap.start_s - view.zero:.2f} s"
            message = f"the clock jumps by {gap.length_s - step:.2f} s at {since}: {jumps[gap]}"
        if line is not None and camera in view.cameras:
            newest = line.frame_time[camera][line.vl_row]
            ages = (line.time - newest)[newest == gap.start_s]
            if len(ages):
                message += f"; ticks see a frame up to {ages.max():.2f} s old"
        yield view.issue(kind, clock.name, message, *gap)


def _find_jumps(clock: Clock, recorded: Sequence[Clock]) -> dict[Span, str]:
    """Where a clock was set, the longest jump first, rather than lacks entries; and what shows it.

    A clock that was set ends apart from those without such a step, and near them less the step; one
    that lacks entries ends with them.
    """
    jumps: dict[Span, str] = {}
    end = float(clock.time[-1])
    for gap in sorted(clock.gaps, key=lambda gap: -gap.length_s):
        moved, half = gap.length_s - clock.step_s, gap.length_s / 2
        ends = np.array([c.time[-1] for c in recorded if np.diff(c.time).max(initial=0) < half])
        apart, left = (np.abs(at - ends).min(initial=np.inf) for at in (end, end - moved))
        if LOST_S <= apart < np.inf and left < apart / 2:
            jumps[gap] = f"it ends {apart:.2f} s from the nearest other clock, {left:.2f} s without"
            end -= moved
    return jumps


def _repeated(view: EpisodeView, clock: Clock) -> Iterator[Issue]:
    still = int(np.count_nonzero(np.diff(clock.time) == 0))
    if still > REPEATED * (len(clock.time) - 1):
        message = f"{still} of {len(clock.time)} entries have the time of the entry before"
        yield view.issue("repeated times", clock.name, message)


def _dropped(view: EpisodeView, clock: Clock) -> Iterator[Issue]:
    """A camera that loses frames one by one; gaps are told apart.

    Its place is the shortest span that holds half of the long steps.
    """
    steps = np.diff(clock.time)
    small = steps < clock.shortest_gap_s
    begun, steps = clock.time[:-1][small], steps[small]
    # Stamps in bursts have long steps between them and lack nothing.
    if len(steps) < _FEWEST or clock.step_s > float(np.median(steps)):
        return
    places = np.flatnonzero(steps >= DROPPED_STEP * clock.step_s)
    long, lost = len(places), float(steps.sum()) / clock.step_s - len(steps)
    if long < DROPPED or min(long, lost) <= DROPPED_SHARE * len(steps):
        return
    starts, stops = begun[places], (begun + steps)[places][(long - 1) // 2 :]
    most = int(np.argmin(stops - starts[: len(stops)]))
    span = float(starts[most]), float(stops[most])
    message = (
        f"{long} of {len(steps)} steps take at least {DROPPED_STEP:g} times the usual "
        f"{1e3 * clock.step_s:.0f} ms (up to {1e3 * steps.max():.0f} ms), half of them here: there "
        f"is time for {lost:.0f} more frames; {len(steps) / steps.sum():.1f} Hz on average"
    )
    yield view.issue("dropped frames", clock.name, message, *span)


def _rate(view: EpisodeView, clock: Clock, expected_hz: float, where: str) -> Iterator[Issue]:
    """The mean rate, without gaps that are told anyway: also entries lost one by one show in it."""
    covered = float(np.ptp(clock.time)) - sum(gap.length_s for gap in clock.gaps)
    rate = (len(clock.time) - 1 - len(clock.gaps)) / covered if covered > 0 else float("inf")
    if abs(rate - expected_hz) > RATE_TOLERANCE * expected_hz:
        message = f"found {rate:.4g} entries a second, expected {expected_hz:.4g} by {where}"
        yield view.issue("rate", clock.name, message)


def _lost_ticks(view: EpisodeView, recorded: Sequence[Clock]) -> Iterator[Issue]:
    """What a stream costs that begins after most of the others or ends before most of them."""
    starts = [float(clock.time[0]) for clock in recorded]
    # A clock that was set ends where it would have without.
    stops = [
        clock.time[-1] - sum(gap.length_s - clock.step_s for gap in _find_jumps(clock, recorded))
        for clock in recorded
    ]
    middle = (len(recorded) - 1) // 2
    for edge, extreme, usual, words in (
        (starts, max(starts), sorted(starts)[middle], "begins {:.2f} s after most others"),
        (stops, min(stops), sorted(stops)[-1 - middle], "ends {:.2f} s before most others"),
    ):
        lost, tick_s, length_s = abs(extreme - usual), _tick_s(view), view.duration_s
        near = min(LOST_S, lost) / 2
        late = [c for c, at in zip(recorded, edge, strict=True) if abs(at - extreme) <= near]
        steps = (DROPPED_STEP * clock.step_s for clock in late)
        if lost >= LOST_S or lost > max(LOST_SHARE * length_s, LOST_TICKS * tick_s, *steps):
            cost = f"about {lost / tick_s:.0f} ticks, {100 * lost / length_s:.0f} % of the episode"
            names = ", ".join(clock.name for clock in late)
            message = f"{words.format(lost)}, which costs {cost}"
            yield view.issue("lost ticks", names, message, *sorted((extreme, usual)))


def _tick_s(view: EpisodeView) -> float:
    line = view.timeline
    return _TICK_S if line is None or len(line.time) < 2 else usual_step(line.time)


def _old_frames(view: EpisodeView) -> Iterator[Issue]:
    """Cameras that are slower than the VL rows, so that rows see the frame of the row before."""
    line = view.timeline
    if line is None or len(line.time) < 2:
        return
    served = int(np.count_nonzero(line.vl_row == 0)) * usual_step(line.time)
    for name, shown in line.frame_time.items():
        age = line.time - shown[line.vl_row]
        usual, oldest = float(np.median(age)), int(np.argmax(age))
        if usual > OLD * served:
            message = (
                f"frames are {usual:.2f} s old at the median tick and {age[oldest]:.2f} s at most, "
                f"expected at most {OLD * served:.2f} s where a VL row serves {served:.2f} s"
            )
            at = float(line.time[oldest])
            yield view.issue("old frames", f"view {name}", message, at, at)


GAP_COLOUR = "#D55E00"
# Colour of a stroke, in the order of the lanes: what feeds a lane stands above it.
_KINDS = {"stream": PALETTE[4], "camera": PALETTE[0], "vl_row": PALETTE[2], "tick": INK}
# Strokes that a lane has room for: of entries nearer than that, one is drawn.
_STROKES = 1500
# VL rows shown from near, and seconds without any.
_ROWS_NEAR, _NEAR_S = 5, 1.5
# Of a lane: how far its marks reach up and down.
_HALF = 0.36


def clock_blocks(view: EpisodeView, draw: Draw, params: Params) -> list[Block]:
    """The lanes and a table of all clocks, the ticks' and VL rows' too; empty without any."""
    clocks = read_clocks(view)
    if not clocks:
        return []
    caption = (
        "When each stream was sampled; hatched boxes are gaps. Lines lead from frames to the VL "
        "row that took them, brackets from a VL row to the ticks that reuse it."
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
    """A lane a clock: over the whole episode, and about five VL rows from near.

    From near, lines lead from each frame to the VL row that took it, and brackets from the row to
    the ticks that reuse it. Streams that were sampled by one clock share a lane.
    """
    clocks = _in_reading_order(read_clocks(view))
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
    whole.set_title("the whole episode (grey: the stretch below)", loc="left", fontsize=10)
    if view.timeline is not None:
        lanes = {clock.name: lane for lane, clock in enumerate(clocks)}
        _draw_reuse(detail, view.timeline, view.zero, lanes, near)
    detail.set_title(f"from near: {near[1] - near[0]:.2f} s", loc="left", fontsize=10)
    detail.set_xlabel("time since the recording began [s]")
    return figure


def _in_reading_order(clocks: Sequence[Clock]) -> list[Clock]:
    """Those with an entry, by kind; streams with the very same times are one of all their names."""
    shown = [clock for clock in clocks if len(clock.time)]
    streams = merge_equal(clock for clock in shown if clock.kind == "stream")
    others = [clock for clock in shown if clock.kind != "stream"]
    return sorted([*streams, *others], key=lambda clock: [*_KINDS].index(clock.kind))


def _choose_near(
    view: EpisodeView, clocks: Sequence[Clock], start: float, stop: float
) -> tuple[float, float]:
    """The stretch in s that is shown from near: five VL rows, around a gap if any.

    The first gap of the topmost lane that has one; without any, the middle.
    """
    line = view.timeline
    step = float("nan") if line is None else usual_step(line.vl_time)
    width = min(_ROWS_NEAR * step if step > 0 else _NEAR_S, max(stop - start, 1e-3))
    gaps = [gap.start_s - width / 4 for clock in clocks for gap in clock.gaps]
    begin = max(min([*gaps, (start + stop - width) / 2][0], stop - width), start)
    return begin, begin + width


def _draw_lane(axis: Axes, clock: Clock, lane: int, zero: float) -> None:
    """A stroke an entry, where entries are dense one a place; and the gaps."""
    low, high = axis.get_xlim()
    time = clock.time[(clock.time >= low + zero) & (clock.time <= high + zero)] - zero
    places = ((time - low) / (high - low) * _STROKES).astype(np.int64)
    time = time[np.unique(places, return_index=True)[1]]
    axis.vlines(time, lane - _HALF, lane + _HALF, colors=_KINDS[clock.kind], lw=1.0)
    spans = [(gap.start_s - zero, gap.length_s) for gap in clock.gaps]
    # One artist for all: thousands of gaps as patches take many seconds.
    axis.broken_barh(
        spans, (lane - _HALF, 2 * _HALF), facecolor="none", hatch="////", lw=1.4,
        edgecolor=GAP_COLOUR, hatchcolor=GAP_COLOUR,
    )  # fmt: skip


def _draw_reuse(
    axis: Axes, line: Timeline, zero: float, lanes: Mapping[str, int], near: tuple[float, float]
) -> None:
    """Lines from frames to VL rows and brackets from VL rows to ticks, between two instants."""
    colour = _KINDS["vl_row"]
    row_lane, tick_lane = lanes["VL rows"], lanes["ticks"]
    rows = np.unique(line.vl_row[(line.time >= near[0]) & (line.vl_time[line.vl_row] <= near[1])])
    for name, time in line.frame_time.items():
        lane = lanes[f"view {name}"]
        tops = [(at - zero, lane) for at in time[rows]]
        ends = zip(tops, [(at - zero, row_lane - _HALF) for at in line.vl_time[rows]], strict=True)
        axis.add_collection(LineCollection([*ends], colors=colour, label=f"took {name}"))
        axis.plot(time[rows] - zero, [lane] * len(rows), "o", ms=5, color=colour, zorder=4)
    for row in rows:
        ticks = line.time[line.vl_row == row] - zero
        across, low = [ticks[0], ticks[0], ticks[-1], ticks[-1]], tick_lane - 0.5
        axis.plot(across, [row_lane + _HALF, low, low, tick_lane - _HALF], color=colour, lw=1.6)
        if line.vl_time[row] >= near[0]:
            at = float(line.vl_time[row]) - zero
            axis.text(at, row_lane, f" row {row}", color=colour, size=8, va="center", clip_on=True)
