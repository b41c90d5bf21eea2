"""What looks wrong in the clocks: gaps, jumps, rates, frames lost, ticks lost, frames too old."""

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.data.recording import Nominal
from pipeline.look.recording.clocks import distinct_clocks, gaps, shortest_gap, usual_step
from pipeline.look.recording.facts import EpisodeView, Flaw, Gap

RATE_TOLERANCE = 0.1
"""Share by which entries a second may differ from what the recording says."""
DROPPED_STEP = 1.5
"""Usual steps from which a camera's step has lost a frame."""
DROPPED, DROPPED_SHARE = 5, 0.05
"""How many such steps there are at least, and what share of the steps they have to exceed, as have
the frames that there was time for: jitter alone leaves no time, as steps get shorter too."""
LOST_S, LOST_SHARE, LOST_TICKS = 0.5, 0.05, 2.5
"""By how much a stream may begin after the others, or end before them: in seconds, or as a share of
a short episode, there by so many ticks and `DROPPED_STEP` of its own steps in any case."""
REPEATED = 0.05
"""Share of entries that may have the time of the entry before."""
OLD = 2.0
"""Times the span that a VL row serves which its frames may usually be old."""

_TICK_S = 0.1
"""Of an episode without two ticks."""
_FEWEST = 20
"""Steps below which nothing is said of how a clock runs."""


def clock_flaws(view: EpisodeView, said: Nominal) -> Iterator[Flaw]:
    """Flaws of kind gap, clock jump, repeated times, rate, dropped frames, lost ticks and old
    frames; `said` is what the recording says of itself.

    A gap shorter than the ticks are apart is none: no tick sees less by it.
    """
    for names, time in distinct_clocks(view).items():
        yield from _gaps(view, names, time)
        yield from _repeated(view, names, time)
        yield from _dropped(view, names, time, said)
    yield from _rates(view, said)
    yield from _lost_ticks(view)
    yield from _old_frames(view)


def _gaps(view: EpisodeView, names: str, time: NDArray[np.float64]) -> Iterator[Flaw]:
    step = usual_step(time)
    tick = _tick_s(view)
    jumps = _jumps(_ends(view), time)
    for gap in gaps(time):
        length = gap.stop_s - gap.start_s
        if length <= tick:
            continue
        jump = jumps.get(gap.start_s)
        kind = "clock jump" if jump else "gap"
        said = (
            f"the clock jumps by {length - step:.2f} s at {gap.start_s - view.zero:.2f} s: "
            f"{jump.why}"
            if jump
            else f"no entry for {length:.2f} s from {gap.start_s - view.zero:.2f} s, expected one "
            f"every {step:.3g} s"
        )
        said += _age_there(view, names, gap)
        yield view.flaw(kind, names, said, gap.start_s, gap.stop_s)


def _ends(view: EpisodeView) -> list[tuple[float, float]]:
    """The longest step of every clock, and its last instant."""
    return [(float(np.diff(time).max(initial=0)), float(time[-1])) for time in view.clocks.values()]


class _Jump(NamedTuple):
    why: str
    apart_s: float
    """By how much it takes the clock apart from others; 0 where none can tell."""


def _jumps(ends: list[tuple[float, float]], time: NDArray[np.float64]) -> dict[float, _Jump]:
    """Where a clock was set, the longest jump first, rather than lacks entries.

    A clock that was set ends apart from those without such a step, and near them less the step; one
    that lacks entries ends with them. Where all have such a step, it was set if the step is longer
    than all its others.
    """
    found: dict[float, _Jump] = {}
    end, step = float(time[-1]), usual_step(time)
    for gap in sorted(gaps(time), key=lambda gap: gap.start_s - gap.stop_s):
        length = gap.stop_s - gap.start_s
        others = [other for longest, other in ends if longest < length / 2]
        if not others:
            rest = float(time[-1] - time[0]) - length
            if length > rest:
                why = f"all its other steps together make {rest:.2f} s"
                found[gap.start_s] = _Jump(why, 0.0)
            continue
        moved = length - step
        apart, left = (min(abs(end - less - other) for other in others) for less in (0, moved))
        if apart >= LOST_S and left < apart / 2:
            why = (
                f"it ends {apart:.2f} s from the nearest other clock, {left:.2f} s without the jump"
            )
            found[gap.start_s] = _Jump(why, moved)
            end -= moved
    return found


def _age_there(view: EpisodeView, names: str, gap: Gap) -> str:
    """What a camera's gap does to the ticks."""
    line = view.timeline
    views = [name for name in view.cameras if f"view {name}" in names.split(", ")]
    if line is None or not views:
        return ""
    shown = line.frame_time[views[0]][line.vl_row]
    ages = (line.time - shown)[shown == gap.start_s]
    return f"; ticks see a frame up to {ages.max():.2f} s old" if len(ages) else ""


def _repeated(view: EpisodeView, names: str, time: NDArray[np.float64]) -> Iterator[Flaw]:
    still = np.diff(time) == 0
    share = float(still.mean()) if len(still) else 0.0
    if share > REPEATED:
        yield view.flaw(
            "repeated times",
            names,
            f"{int(still.sum())} of {len(time)} entries have the time of the entry before; "
            "expected each its own time",
        )


def _dropped(
    view: EpisodeView, names: str, time: NDArray[np.float64], said: Nominal
) -> Iterator[Flaw]:
    """A camera that loses frames one by one; gaps are told apart.

    Its place is the shortest span that holds half of the long steps.
    """
    steps = np.diff(time)
    usual = usual_step(time)
    small = steps < shortest_gap(time)
    begun, steps = time[:-1][small], steps[small]
    # Stamps in bursts have long steps between them and lack nothing.
    if not names.startswith("view ") or len(steps) < _FEWEST or usual > float(np.median(steps)):
        return
    places = np.flatnonzero(steps >= DROPPED_STEP * usual)
    long = len(places)
    lost = float(steps.sum()) / usual - len(steps)
    if long < DROPPED or min(long, lost) <= DROPPED_SHARE * len(steps):
        return
    half = (long + 1) // 2
    starts, stops = begun[places], (begun + steps)[places]
    most = int(np.argmin(stops[half - 1 :] - starts[: long - half + 1]))
    start, stop = float(starts[most]), float(stops[most + half - 1])
    expected = _expected_rate(names, said)
    nominal = "" if expected is None else f", {expected:.3g} Hz by {said.where}"
    yield view.flaw(
        "dropped frames",
        names,
        f"{long} of {len(steps)} steps take at least {DROPPED_STEP:g} times the usual "
        f"{1e3 * usual:.0f} ms (up to {1e3 * steps.max():.0f} ms), half of them from "
        f"{start - view.zero:.2f} to {stop - view.zero:.2f} s: there is time for {lost:.0f} "
        f"more frames; {len(steps) / steps.sum():.1f} Hz on average{nominal}",
        start,
        stop,
    )


def _expected_rate(names: str, said: Nominal) -> float | None:
    return next((said.rates_hz[name] for name in names.split(", ") if name in said.rates_hz), None)


def _rates(view: EpisodeView, said: Nominal) -> Iterator[Flaw]:
    """The mean rate, without gaps that are told anyway: also entries lost one by one show in it."""
    for names, time in distinct_clocks(view).items():
        expected = _expected_rate(names, said)
        if expected is None or len(time) < 3:
            continue
        lost = sum(gap.stop_s - gap.start_s for gap in gaps(time))
        covered = float(time[-1] - time[0]) - lost
        found = (len(time) - 1 - len(gaps(time))) / covered if covered > 0 else float("inf")
        if abs(found - expected) > RATE_TOLERANCE * expected:
            yield view.flaw(
                "rate",
                names,
                f"found {found:.4g} entries a second, expected {expected:.4g} by {said.where}",
            )


def _lost_ticks(view: EpisodeView) -> Iterator[Flaw]:
    """What a stream costs that begins after most of the others or ends before most of them.

    A clock that was set ends where it would have without.
    """
    clocks = view.clocks
    if len(clocks) < 2:
        return
    most, have, do = (
        ("the other stream", "has", "does") if len(clocks) == 2 else ("most streams", "have", "do")
    )
    middle = (len(clocks) - 1) // 2
    starts = {name: float(time[0]) for name, time in clocks.items()}
    ends = _ends(view)
    stops = {
        name: float(time[-1]) - sum(jump.apart_s for jump in _jumps(ends, time).values())
        for name, time in clocks.items()
    }
    begun = sorted(starts.values())[middle]
    ended = sorted(stops.values(), reverse=True)[middle]
    for edge, time, limit, said in (
        (starts, max(starts.values()), begun, f"begins {{:.2f}} s after {most} {have}"),
        (stops, min(stops.values()), ended, f"ends {{:.2f}} s before {most} {do}"),
    ):
        lost = abs(time - limit)
        names = [name for name, at in edge.items() if abs(at - time) <= min(LOST_S, lost) / 2]
        if lost < LOST_S and not _costs_much(view, names, lost):
            continue
        yield view.flaw(
            "lost ticks",
            ", ".join(names),
            f"{said.format(lost)}; no tick can stand there ({_share(view, lost)})",
            min(time, limit),
            max(time, limit),
        )


def _costs_much(view: EpisodeView, names: Iterable[str], lost_s: float) -> bool:
    """Whether streams that lack less than `LOST_S` cost much of a short episode by it."""
    own_s = max(usual_step(view.clocks[name]) for name in names)
    allowed = (LOST_SHARE * view.duration_s, LOST_TICKS * _tick_s(view), DROPPED_STEP * own_s)
    return all(lost_s > limit for limit in allowed)


def _tick_s(view: EpisodeView) -> float:
    line = view.timeline
    return _TICK_S if line is None or len(line.time) < 2 else usual_step(line.time)


def _share(view: EpisodeView, lost_s: float) -> str:
    ticks = f"about {lost_s / _tick_s(view):.0f} ticks, "
    return f"{ticks}{100 * lost_s / view.duration_s:.0f} % of the episode's {view.duration_s:.2f} s"


def _old_frames(view: EpisodeView) -> Iterator[Flaw]:
    """Cameras that are slower than the VL rows, so that rows see the frame of the row before."""
    line = view.timeline
    if line is None or len(line.time) < 2:
        return
    reuse = int(np.count_nonzero(line.vl_row == 0))
    served = reuse * usual_step(line.time)
    ages: Mapping[str, NDArray[np.float64]] = {
        name: line.time - at[line.vl_row] for name, at in line.frame_time.items()
    }
    for name, age in ages.items():
        usual, oldest = float(np.median(age)), int(np.argmax(age))
        if usual <= OLD * served:
            continue
        seen = len(np.unique(line.frames[name]))
        yield view.flaw(
            "old frames",
            f"view {name}",
            f"frames are {usual:.2f} s old at the median tick and {age[oldest]:.2f} s at most, "
            f"expected at most {OLD * served:.2f} s where a VL row serves {served:.2f} s; "
            f"{len(line.vl_time)} VL rows see {seen} frames",
            float(line.time[oldest]),
            float(line.time[oldest]),
        )
