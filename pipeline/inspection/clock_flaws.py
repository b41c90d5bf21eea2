"""What looks wrong in the clocks: gaps, jumps, rates, counts, ticks lost, frames too old."""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from pipeline.inspection.clocks import distinct_clocks, gaps, usual_step
from pipeline.inspection.facts import EpisodeView, Flaw, Gap
from pipeline.inspection.nominal import said_by
from pipeline.recordings.reader import FileRecording

RATE_TOLERANCE = 0.1
"""Share by which entries a second may differ from what the recording says."""
COUNT_TOLERANCE = 0.1
"""Share of its frames that a view may lack; two frames are never too few."""
OTHER_RATE = 1.8
"""Times as fast a camera is one of another kind, whose frames are not compared in number."""
LOST_S = 0.5
"""Seconds by which a stream may begin after the others, or end before them."""
REPEATED = 0.05
"""Share of entries that may have the time of the entry before."""
OLD = 2.0
"""Times the span that a VL row serves which its frames may usually be old."""

_TICK_S = 0.1
"""Of an episode without ticks."""
_LISTED = 5
"""Gaps of one clock that are told one by one; of more, the longest and their number."""


def clock_flaws(view: EpisodeView) -> Iterator[Flaw]:
    """Flaws of kind gap, clock jump, repeated times, rate, frame count, missing, lost ticks and
    old frames.

    A gap shorter than the ticks are apart is none: no tick sees less by it.
    """
    for names, time in distinct_clocks(view).items():
        yield from _gaps(view, names, time)
        yield from _repeated(view, names, time)
    yield from _rates(view)
    yield from _counts(view)
    yield from _lost_ticks(view)
    yield from _old_frames(view)


def _gaps(view: EpisodeView, names: str, time: NDArray[np.float64]) -> Iterator[Flaw]:
    step = usual_step(time)
    tick = _TICK_S if view.timeline is None else usual_step(view.timeline.time)
    found = [gap for gap in gaps(time) if not gap.stop_s - gap.start_s <= tick]
    found.sort(key=lambda gap: gap.start_s - gap.stop_s)
    rest = float(time[-1] - time[0])
    shown = found if len(found) <= _LISTED else found[:1]
    for gap in shown:
        length = gap.stop_s - gap.start_s
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
        if len(found) > _LISTED:
            total = sum(one.stop_s - one.start_s for one in found)
            said += f"; {len(found)} gaps in all, {total:.2f} s together"
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


def _rates(view: EpisodeView) -> Iterator[Flaw]:
    """The mean rate, without gaps that are told anyway: also entries lost one by one show in it."""
    said = said_by(view)
    for names, time in distinct_clocks(view).items():
        expected = next((said.rates_hz[n] for n in names.split(", ") if n in said.rates_hz), None)
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


def _counts(view: EpisodeView) -> Iterator[Flaw]:
    said = said_by(view)
    frames = {name: len(camera.time) for name, camera in view.cameras.items()}
    recorded = _recorded_views(view)
    for name in said.views:
        if recorded is not None and not any(
            n == name or n.startswith(f"{name}_") for n in recorded
        ):
            message = f"no frame; {said.where} lists {', '.join(said.views)}"
            yield view.flaw("missing", f"view {name}", message)
    most = max(frames.values(), default=0)
    if said.frames is not None and _too_few(most, said.frames):
        message = f"{most} frames in the view that has most, {said.where} says {said.frames}"
        yield view.flaw("frame count", "cameras", message)
    for name, found in frames.items():
        expected = max(frames[other] for other in frames if _same_rate(view, name, other))
        if _too_few(found, expected):
            message = f"{found} frames, another view of its rate has {expected}"
            yield view.flaw("frame count", f"view {name}", message)


def _too_few(found: int, expected: int) -> bool:
    return expected - found > max(2, COUNT_TOLERANCE * expected)


def _same_rate(view: EpisodeView, one: str, other: str) -> bool:
    """Whether two cameras may be meant to run alike: a rig can have a slow and a fast one."""
    step, beside = (usual_step(view.cameras[name].time) for name in (one, other))
    return one == other or max(step, beside) < OTHER_RATE * min(step, beside)


def _recorded_views(view: EpisodeView) -> tuple[str, ...] | None:
    """All views of the recording, those that `data.views` leaves out too; None if not readable."""
    one = view.recording
    if not isinstance(one, FileRecording) or any("cameras" in flaw.stream for flaw in view.flaws):
        return None
    return tuple(one.all_views())


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
