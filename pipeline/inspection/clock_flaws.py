"""What looks wrong in the clocks: gaps, jumps, rates, frames lost, ticks lost, frames too old."""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from pipeline.inspection.clocks import distinct_clocks, gaps, shortest_gap, usual_step
from pipeline.inspection.facts import EpisodeView, Flaw, Gap
from pipeline.recordings.recording import Nominal

RATE_TOLERANCE = 0.1
"""Share by which entries a second may differ from what the recording says."""
DROPPED_STEP = 1.5
"""Usual steps from which a camera's step has lost a frame."""
DROPPED, DROPPED_SHARE = 5, 0.05
"""How many such steps there are at least, and what share of the steps they have to exceed, as have
the frames that there was time for: jitter alone leaves no time, as steps get shorter too."""
LOST_S = 0.5
"""Seconds by which a stream may begin after the others, or end before them."""
REPEATED = 0.05
"""Share of entries that may have the time of the entry before."""
OLD = 2.0
"""Times the span that a VL row serves which its frames may usually be old."""

_TICK_S = 0.1
"""Of an episode without ticks."""
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
    tick = _TICK_S if view.timeline is None else usual_step(view.timeline.time)
    rest = float(time[-1] - time[0])
    for gap in gaps(time):
        length = gap.stop_s - gap.start_s
        if length <= tick:
            continue
        jumped = length > rest - length
        kind = "clock jump" if jumped else "gap"
        said = (
            f"the clock jumps by {length:.2f} s at {gap.start_s - view.zero:.2f} s, and all its "
            f"other steps together make {rest - length:.2f} s"
            if jumped
            else f"no entry for {length:.2f} s from {gap.start_s - view.zero:.2f} s, expected one "
            f"every {step:.3g} s"
        )
        said += _age_there(view, names, gap)
        yield view.flaw(kind, names, said, gap.start_s, gap.stop_s)


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
    """A camera that loses frames one by one, all over the episode; gaps are told apart."""
    steps = np.diff(time)
    usual = usual_step(time)
    steps = steps[steps < shortest_gap(time)]
    # Stamps in bursts have long steps between them and lack nothing.
    if not names.startswith("view ") or len(steps) < _FEWEST or usual > float(np.median(steps)):
        return
    long = int(np.count_nonzero(steps >= DROPPED_STEP * usual))
    lost = float(steps.sum()) / usual - len(steps)
    if long < DROPPED or min(long, lost) <= DROPPED_SHARE * len(steps):
        return
    expected = _expected_rate(names, said)
    nominal = "" if expected is None else f", {expected:.3g} Hz by {said.where}"
    yield view.flaw(
        "dropped frames",
        names,
        f"{long} of {len(steps)} steps take at least {DROPPED_STEP:g} times the usual "
        f"{1e3 * usual:.0f} ms (up to {1e3 * steps.max():.0f} ms): there is time for {lost:.0f} "
        f"more frames; {len(steps) / steps.sum():.1f} Hz on average{nominal}",
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
    """What a stream costs that begins after most of the others or ends before most of them."""
    clocks = view.clocks
    if len(clocks) < 2:
        return
    middle = (len(clocks) - 1) // 2
    starts = {name: float(time[0]) for name, time in clocks.items()}
    stops = {name: float(time[-1]) for name, time in clocks.items()}
    begun = sorted(starts.values())[middle]
    ended = sorted(stops.values(), reverse=True)[middle]
    for time, limit, said in (
        (max(starts.values()), begun, "begins {:.2f} s after most streams have"),
        (min(stops.values()), ended, "ends {:.2f} s before most streams do"),
    ):
        lost = abs(time - limit)
        if lost < LOST_S:
            continue
        edge = starts if time > limit else stops
        names = ", ".join(name for name, at in edge.items() if abs(at - time) < LOST_S / 2)
        yield view.flaw(
            "lost ticks",
            names,
            f"{said.format(lost)}; no tick can stand there ({_share(view, lost)})",
            min(time, limit),
            max(time, limit),
        )


def _share(view: EpisodeView, lost_s: float) -> str:
    return f"{100 * lost_s / view.duration_s:.0f} % of the episode's {view.duration_s:.2f} s"


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
