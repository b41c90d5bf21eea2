"""All recordings: read and checked one by one, and their page.

The rules and thresholds of most issues are in `clocks`, `streams` and `cameras`; here are those for
missing parts and for several recordings. Most rules compare an episode with itself, so they assume
nothing about the robot.
"""

import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from tqdm import tqdm

from pipeline.base.config import Params
from pipeline.base.errors import Issue, StoreMismatch
from pipeline.base.text import Table, counted, duration
from pipeline.data import Opened, Recording
from pipeline.data.episode import Embodiment, common_embodiment
from pipeline.data.timeline import ActionRotation, choose_action_rotation, rate_notes
from pipeline.look.page.blocks import Issues, Picture, Report, Section, Text, next_steps
from pipeline.look.recording.cameras import camera_blocks, find_frame_issues
from pipeline.look.recording.clocks import clock_blocks, find_clock_issues
from pipeline.look.recording.episode import Draw, LoadedRecording, view_episode
from pipeline.look.recording.samples import prompt_blocks, sample_blocks
from pipeline.look.recording.streams import (
    find_channel_issues,
    motion_blocks,
    sensor_blocks,
    statistics_blocks,
)

_TOPICS = {
    "Camera views": camera_blocks,
    "Sensor": sensor_blocks,
    "Motion and actions": motion_blocks,
    "Clocks": clock_blocks,
    "Statistics by channel": statistics_blocks,
}
_FEW = 30
"""Fewer episodes leave too few to test on."""
NOTHING = "Nothing looks wrong: every episode was read and every check passed."
# Most episodes in the table of all: those with issues, then the first.
ROWS = 100


@dataclass
class RecordingSummary:
    """One recording in a line; `counts` are entries by clock (`LoadedRecording.clocks`)."""

    source: str
    episode: str
    format: str
    path: Path
    instruction: str | None
    duration_s: float
    ticks: int
    vl_rows: int
    counts: Mapping[str, int]
    issues: list[Issue]

    @property
    def frames(self) -> dict[str, int]:
        """Number of frames by view."""
        views = {name: count for name, count in self.counts.items() if name.startswith("view ")}
        return {name.removeprefix("view "): count for name, count in views.items()}

    @property
    def errors(self) -> int:
        """Number of errors among its issues."""
        return sum(issue.severity == "error" for issue in self.issues)

    @property
    def warnings(self) -> int:
        """Number of warnings among its issues."""
        return len(self.issues) - self.errors


@dataclass(frozen=True)
class RecordingsOverview:
    """All recordings that were opened, and everything that is wrong with them.

    `summaries` are in the order in which recordings were opened; `common` are the issues of whole
    sources and of recordings that could not be opened; `rotation` is the kind of rotation that
    `data.action_rotation` means for these recordings.
    """

    summaries: tuple[RecordingSummary, ...]
    common: tuple[Issue, ...]
    rotation: ActionRotation

    @property
    def issues(self) -> tuple[Issue, ...]:
        """The common ones, then episode by episode."""
        return (*self.common, *(issue for summary in self.summaries for issue in summary.issues))

    @property
    def views(self) -> tuple[str, ...]:
        """The views of all recordings, sorted."""
        return tuple(sorted({view for summary in self.summaries for view in summary.frames}))

    def choose(self, count: int) -> tuple[int, ...]:
        """Indices into `summaries` of at most `count` recordings to show in detail, ascending.

        Those with most errors, then most warnings, are taken first; the others are evenly spread.
        """
        ranked = worst_first(self.summaries)
        worst = [place for place in ranked if self.summaries[place].issues][:count]
        sound = [place for place in range(len(self.summaries)) if place not in worst]
        left = min(count - len(worst), len(sound))
        spread = np.linspace(0, len(sound) - 1, left).round().astype(int).tolist() if left else []
        return tuple(sorted([*worst, *(sound[place] for place in spread)]))


def worst_first(summaries: Sequence[RecordingSummary]) -> list[int]:
    """Indices into `summaries`: those with most errors, then most warnings, first."""
    counts = [(-summary.errors, -summary.warnings) for summary in summaries]
    return sorted(range(len(summaries)), key=counts.__getitem__)


def survey_recordings(opened: Opened, params: Params) -> RecordingsOverview:
    """Read and check every recording; a broken one does not stop the others from being read.

    Raises `ConfigError` where poses need `data.action_hz`.
    """
    rotation = choose_action_rotation(params.data.action_rotation, opened.recordings)
    summaries: list[RecordingSummary] = []
    embodiments: list[tuple[Recording, Embodiment]] = []
    rates: list[tuple[str, float | None, float]] = []
    for recording in tqdm(opened.recordings, "inspecting", unit="episode", disable=None):
        view = view_episode(recording, params.data, rotation)
        summaries.append(_summarise(view))
        if (line := view.timeline) is not None:
            kind = Embodiment.of(line.action_channels, line.action_kind, view.sensor, view.state)
            embodiments.append((recording, kind))
            rates.append((recording.source, line.recorded_hz, line.fastest_hz))
    _warn_of_missing(summaries)
    common = list(_not_opened(opened))
    try:
        if embodiments:
            common_embodiment(embodiments, "store", "Inspect and extract them apart.")
    except StoreMismatch as error:
        common.append(Issue(severity="error", kind="embodiment", message=str(error)))
    # The sources whose ticks are not the recorded rows.
    for source, note in rate_notes(rates, params.data.action_hz).items():
        note += "; with data.action_hz null the recorded rows are the ticks"
        common.append(_warning("tick rate", note, source, stream="ticks"))
    return RecordingsOverview(tuple(summaries), tuple(common), rotation)


def _summarise(view: LoadedRecording) -> RecordingSummary:
    recording, line = view.recording, view.timeline
    return RecordingSummary(
        source=recording.source,
        episode=recording.id,
        format=recording.format,
        path=recording.path,
        instruction=view.instruction,
        duration_s=view.duration_s,
        ticks=0 if line is None else len(line.time),
        vl_rows=0 if line is None else len(line.vl_time),
        counts={name: len(time) for name, time in view.clocks.items()},
        issues=list(find_issues(view)),
    )


def find_issues(view: LoadedRecording) -> tuple[Issue, ...]:
    """The issues of this episode and of reading it: errors first, then by time."""
    issues = list(view.issues)
    issues += [*find_clock_issues(view), *_missing(view)]
    issues += [*find_channel_issues(view), *find_frame_issues(view)]
    issues.sort(key=lambda issue: (issue.severity != "error", issue.start_s or float("-inf")))
    return tuple(issues)


def _missing(view: LoadedRecording) -> Iterator[Issue]:
    """An episode without a picture."""
    if view.cameras or any("cameras" in issue.stream.split(", ") for issue in view.issues):
        return
    recorded = view.recording.all_views()  # with those that `data.views` leaves out
    left_out = f"; data.views leaves out {', '.join(recorded)}" if recorded else ""
    message = f"no camera has a frame{left_out}: the VLM would see no picture"
    yield view.issue("missing", "cameras", message)


def _warn_of_missing(summaries: Sequence[RecordingSummary]) -> None:
    """Warn if an episode lacks what most of its source and format have, unless already reported."""
    alike: dict[tuple[str, str], list[RecordingSummary]] = defaultdict(list)
    for summary in summaries:
        alike[summary.source, summary.format].append(summary)
    for group in alike.values():
        held = Counter(name for summary in group for name in summary.counts)
        usual = {name for name, count in held.items() if 2 * count > len(group)}
        for summary in group:
            reported = {name for issue in summary.issues for name in issue.stream.split(", ")}
            views = {name for name in usual if name.startswith("view ")}
            reported |= views if "cameras" in reported else set()
            reported |= {"poses"} & usual if "state" in reported else set()  # its columns
            if lacking := sorted(usual - summary.counts.keys() - reported):
                message = "not there; most episodes of this source have it"
                place = summary.source, summary.episode, ", ".join(lacking)
                summary.issues.append(_warning("missing", message, *place))


def _not_opened(opened: Opened) -> Iterator[Issue]:
    for bad in opened.bad:
        yield Issue(
            severity="error", kind="unreadable", message=bad.reason,
            source=bad.source, episode=bad.where.name,
        )  # fmt: skip
    for line in opened.missing:
        source, _, message = line.partition(": ")
        yield _warning("missing", message, source)


def _warning(kind: str, message: str, source: str, episode: str = "", stream: str = "") -> Issue:
    return Issue(
        severity="warning", kind=kind, message=message,
        source=source, episode=episode, stream=stream,
    )  # fmt: skip


def recordings_report(opened: Opened, params: Params, name: str) -> Report:
    """The page of these recordings, which the reader knows as `name`.

    Every recording is read and checked, one in memory at a time; `inspect.episodes` of them are
    shown in detail. Pictures read their recording again when they are drawn. A sentence replaces
    every part that cannot be shown. Raises `ConfigError` where poses need `data.action_hz`.
    """
    overview = survey_recordings(opened, params)
    summaries, chosen = overview.summaries, overview.choose(params.inspect.episodes)

    @lru_cache(maxsize=1)
    def view_of(index: int) -> LoadedRecording:
        return view_episode(opened.recordings[index], params.data, overview.rotation)

    def drawer(index: int, prefix: str) -> Draw:
        # The view is read again when a picture is drawn, so a long page holds one in memory.
        return lambda name, caption, draw: Picture(
            f"{prefix}{name}", caption, lambda: draw(view_of(index))
        )

    # The model's input is shown for the episode with fewest errors that has ticks.
    model = min(chosen, key=lambda index: (not summaries[index].ticks, summaries[index].errors))
    sections = [
        Section("What looks wrong", [Issues(overview.issues, NOTHING)]),
        Section("Episodes", [_episodes_table(overview, chosen)]),
    ]
    for place, index in enumerate(chosen, start=1):
        plain = re.sub(r"[^A-Za-z0-9]+", "_", summaries[index].episode).strip("_")[-40:]
        draw = drawer(index, f"episode{place}-{plain or 'episode'}-")
        sections.append(_episode_section(overview, index, view_of(index), draw, params))
    samples = sample_blocks(view_of(model), drawer(model, ""), params)
    prompt = prompt_blocks(view_of(model), params, overview.views)
    words = Text(f"Of the episode `{summaries[model].episode}`, under the params in force.")
    parts = [Section("Samples and batch", samples), Section("Prompt", prompt)]
    sections.append(Section("What the model and the policy get", [words], parts))
    data = params.data
    rate = "the recorded rows" if data.action_hz is None else f"{data.action_hz:g} Hz"
    summary = f"Ticks at {rate}, one VL row every {data.vlm_reuse_count} ticks. Times count from "
    summary += "the first instant of an episode."
    sections.append(next_steps(*_advice(overview)))
    return Report(f"Recordings: {name}", summary, _tiles(overview), sections, _verdict(overview))


def _wrong(overview: RecordingsOverview) -> tuple[int, int]:
    """The numbers of errors and of warnings."""
    errors = sum(issue.severity == "error" for issue in overview.issues)
    return errors, len(overview.issues) - errors


def _verdict(overview: RecordingsOverview) -> str:
    errors, warnings = _wrong(overview)
    if errors:
        return f"{counted(errors, 'error')} to mend before extraction"
    if warnings:
        return f"Ready to extract, with {counted(warnings, 'warning')} to look at"
    return "Ready to extract: nothing looks wrong"


def _advice(overview: RecordingsOverview) -> Iterator[str]:
    errors, warnings = _wrong(overview)
    if errors:
        yield (
            "Mend what the errors name and look again, or leave those episodes out: "
            "`data.on_bad_episode: skip`."
        )
    if warnings:
        yield "Look at each warning in the pictures: it may be the robot's, or the recorder's."
    episodes = len(overview.summaries)
    if episodes < _FEW:
        yield (
            f"Record more: {counted(episodes, 'episode')} can show that the pipeline runs, not "
            f"that a policy works. {_FEW} or more leave enough to test on."
        )
    if not errors:
        yield "Name the recordings in `data.sources`, then `vla-cache extract`."


def _tiles(overview: RecordingsOverview) -> list[tuple[str, str]]:
    summaries = overview.summaries
    errors, warnings = _wrong(overview)
    return [
        ("episodes", f"{len(summaries):,}"),
        ("recorded", duration(sum(summary.duration_s for summary in summaries))),
        ("ticks", f"{sum(summary.ticks for summary in summaries):,}"),
        ("VL rows", f"{sum(summary.vl_rows for summary in summaries):,}"),
        ("cameras", f"{len(overview.views)}"),
        ("errors", f"{errors:,}"),
        ("warnings", f"{warnings:,}"),
    ]


def _episodes_table(overview: RecordingsOverview, chosen: Sequence[int]) -> Table:
    summaries = overview.summaries
    shown = sorted({*chosen, *worst_first(summaries)[:ROWS]})
    heads = [
        "source", "episode", "errors", "warnings", "length [s]", "ticks", "VL rows", "frames",
        "readings", "states", "format", "instruction",
    ]  # fmt: skip
    rows = [
        (
            summary.source, summary.episode, summary.errors, summary.warnings, summary.duration_s,
            summary.ticks, summary.vl_rows, ", ".join(map(str, summary.frames.values())),
            *(summary.counts.get(stream, 0) for stream in ("sensor", "state")), summary.format,
            summary.instruction,
        )
        for summary in (summaries[at] for at in shown)
    ]  # fmt: skip
    caption = f"{len(shown)} of {len(summaries):,} episodes; those in bold are shown below."
    strong = frozenset(row for row, index in enumerate(shown) if index in chosen)
    return Table(heads, rows, caption, strong)


def _episode_section(
    overview: RecordingsOverview, index: int, view: LoadedRecording, draw: Draw, params: Params
) -> Section:
    """Every topic of one episode."""
    summary = overview.summaries[index]
    words = f"`{summary.path}`, format {summary.format}: “{summary.instruction or '–'}”"
    several = len({summary.source for summary in overview.summaries}) > 1
    title = f"{summary.source} / {summary.episode}" if several else summary.episode
    absent = Text("The episode has none.")
    parts = {topic: blocks_of(view, draw, params) for topic, blocks_of in _TOPICS.items()}
    return Section(
        title, [Text(words)], [Section(topic, parts[topic] or [absent]) for topic in parts]
    )
