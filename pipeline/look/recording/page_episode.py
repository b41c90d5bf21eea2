"""One recording -> its section: what each stream holds, and when."""

import math
import re
from collections.abc import Callable, Sequence
from functools import partial

from matplotlib.figure import Figure

from pipeline.base.config import InspectParams
from pipeline.look.page.blocks import Block, Issues, Picture, Section, Table, Text
from pipeline.look.recording.clocks import GAP_FACTOR, clocks
from pipeline.look.recording.contact import RULE, contacts
from pipeline.look.recording.facts import Clock, EpisodeView, Flaw
from pipeline.look.recording.frames import frames_at, read_frames, spread_ticks
from pipeline.look.recording.overview import EpisodeSummary
from pipeline.look.recording.page_flaws import notices
from pipeline.look.recording.page_statistics import statistics_table
from pipeline.look.recording.pictures import camera_views, clock_lanes, clock_steps, motion, sensor
from pipeline.look.recording.statistics import channel_statistics

NOTHING_WRONG = "Nothing looks wrong in this episode."
Viewer = Callable[[int], EpisodeView]
"""Reads a recording by its place, or hands out the one that was read last."""


def episode_section(
    summary: EpisodeSummary,
    place: int,
    view_of: Callable[[], EpisodeView],
    flaws: Sequence[Flaw],
    wanted: InspectParams,
    several: bool,
    alone: bool,
) -> Section:
    """Everything of one episode; `place` counts the sections and begins its pictures' names.

    `several` sources name the episode's own; of an episode `alone` the page has said what is wrong.
    """
    view = view_of()
    stem = f"episode{place}-{_plain(summary.episode)}"
    draw = partial(_picture, stem, view_of)
    title = f"{summary.source} / {summary.episode}" if several else summary.episode
    zero = {(summary.source, summary.episode): summary.zero}
    return Section(
        title,
        [
            Text(f"`{summary.path}`, format {summary.format}: “{summary.instruction or '–'}”"),
            *([] if alone else [Issues(notices(flaws, zero), NOTHING_WRONG)]),
        ],
        [
            Section("Camera views", _views(view, draw, wanted.ticks, flaws)),
            Section("Sensor", _sensor(view, draw, flaws)),
            Section("Motion and actions", _motion(view, draw)),
            Section("Clocks", _clocks(view, draw)),
            Section("Statistics by channel", _statistics(view)),
        ],
    )


Draw = Callable[[str, str, Callable[[EpisodeView], Figure]], Picture]


def _picture(
    stem: str,
    view_of: Callable[[], EpisodeView],
    name: str,
    caption: str,
    draw: Callable[[EpisodeView], Figure],
) -> Picture:
    # The view is read again when the picture is drawn, so that a long page holds one in memory.
    return Picture(f"{stem}-{name}", caption, lambda: draw(view_of()))


def _views(view: EpisodeView, draw: Draw, count: int, flaws: Sequence[Flaw]) -> list[Block]:
    if not view.cameras:
        return [Text(_why(flaws, "cameras", "This episode has no camera views."))]
    ticks = spread_ticks(view, count)
    if not ticks:
        return [Text(_why(flaws, "ticks", "No view is shown: the episode has no ticks."))]
    shown, broken = read_frames(view, ticks)
    blocks: list[Block] = [Text(f"{one.stream} is not shown: {one.message}") for one in broken]
    if shown:
        caption = (
            f"What each view shows at {len(ticks)} ticks, evenly from the first to the last: the "
            "last frame at or before the tick."
        )
        drawing = draw(
            "views", caption, lambda view: camera_views(view, ticks, frames_at(view, ticks))
        )
        blocks.append(drawing)
    return blocks


def _sensor(view: EpisodeView, draw: Draw, flaws: Sequence[Flaw]) -> list[Block]:
    if view.sensor is None:
        return [Text(_why(flaws, "sensor", "This episode has no sensor stream."))]
    wide = len(view.sensor.channels.names)
    touching = contacts(view)
    spans = ", ".join(
        f"{one.start_s - view.zero:.2f}–{one.stop_s - view.zero:.2f} s" for one in touching
    )
    said = f"Contact, by the force alone: {spans}." if spans else "No contact is seen in the force."
    caption = f"The sensor's {wide:,} channels over time, contact shaded. {said} {RULE}"
    return [draw("sensor", caption, lambda view: sensor(view, contacts(view)))]


def _motion(view: EpisodeView, draw: Draw) -> list[Block]:
    if view.state is None and view.poses is None and view.action is None:
        return [Text("Neither state nor poses nor actions of this episode can be read.")]
    caption = "State of the robot as recorded, by unit, and the actions at the ticks."
    return [draw("motion", caption, motion)]


def _clocks(view: EpisodeView, draw: Draw) -> list[Block]:
    found = clocks(view)
    if not found:
        return [Text("No stream of this episode has a clock that can be read.")]
    lanes = draw(
        "clocks",
        "When each stream was sampled, and which VL row serves which ticks. "
        "Gaps are marked; rates are usual ones.",
        lambda view: clock_lanes(view, clocks(view)),
    )
    steps = draw(
        "steps",
        "How long a step from one entry to the next takes: a narrow peak is a steady clock.",
        lambda view: clock_steps(clocks(view)),
    )
    return [lanes, _clock_table(view, found), steps]


def _clock_table(view: EpisodeView, found: Sequence[Clock]) -> Table:
    first = [one.time[0] - view.zero if len(one.time) else None for one in found]
    last = [one.time[-1] - view.zero if len(one.time) else None for one in found]
    jitters = [one.jitter_s for one in found]
    unit, size = jitter_unit(jitters)
    heads = [
        *("clock", "entries", "first [s]", "last [s]"),
        *("usual rate [Hz]", "on average [Hz]", f"jitter [{unit}]", "gaps"),
    ]
    rows = [
        (
            *(one.name, len(one.time), begin, end),
            *(one.rate_hz, one.mean_rate_hz, jitter / size, len(one.gaps)),
        )
        for one, begin, end, jitter in zip(found, first, last, jitters, strict=True)
    ]
    said = (
        "The usual rate is one over the usual step; on average are the steps over their time, lost "
        f"entries and gaps included. A gap is a step of at least {GAP_FACTOR:g} usual ones. Jitter "
        "is the standard deviation of the steps that are no gaps."
    )
    return Table(heads, rows, said)


def jitter_unit(jitters_s: Sequence[float]) -> tuple[str, float]:
    """The largest of s, ms and µs, with its seconds, in which the largest jitter is at least 1."""
    largest = max((one for one in jitters_s if not math.isnan(one)), default=0.0)
    units = {"s": 1.0, "ms": 1e-3, "µs": 1e-6}
    return next((one for one in units.items() if largest >= one[1]), ("µs", 1e-6))


def _statistics(view: EpisodeView) -> list[Block]:
    found = channel_statistics(view)
    if not found:
        return [Text("No numeric stream of this episode can be read.")]
    return [statistics_table(found)]


def _why(flaws: Sequence[Flaw], stream: str, otherwise: str) -> str:
    """What a flaw says of a stream that is not there, else that it was not recorded."""
    for flaw in flaws:
        if stream in flaw.stream.split(", ") and flaw.severity == "error":
            return f"Not shown. {flaw.message}"
    return otherwise


def _plain(name: str) -> str:
    """An episode's id as a part of a file's name."""
    return re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")[-40:] or "episode"
