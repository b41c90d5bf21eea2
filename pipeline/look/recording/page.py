"""The page of recordings: a table of all, what looks wrong, and some of them in every detail."""

import re
from collections.abc import Sequence
from functools import lru_cache

from pipeline.base.config import Params
from pipeline.base.format import duration
from pipeline.base.table import Table
from pipeline.data import Opened
from pipeline.look.page.blocks import Issues, Picture, Report, Section, Text
from pipeline.look.recording.cameras import camera_blocks
from pipeline.look.recording.channels import statistics_blocks
from pipeline.look.recording.clocks import clock_blocks
from pipeline.look.recording.episode import Draw, EpisodeView, view_episode
from pipeline.look.recording.overview import RecordingsOverview, survey_recordings, worst_first
from pipeline.look.recording.samples import prompt_blocks, sample_blocks
from pipeline.look.recording.streams import motion_blocks, sensor_blocks

_TOPICS = {
    "Camera views": camera_blocks,
    "Sensor": sensor_blocks,
    "Motion and actions": motion_blocks,
    "Clocks": clock_blocks,
    "Statistics by channel": statistics_blocks,
}
NOTHING = "Nothing looks wrong: every episode was read and every check passed."
# Most episodes in the table of all: those with issues, then the first.
ROWS = 100


def recordings_report(opened: Opened, params: Params, name: str) -> Report:
    """The page of these recordings, which the reader knows as `name`.

    Every recording is read and checked, one in memory at a time; `inspect.episodes` of them are
    shown in detail. Pictures read their recording again when they are drawn. A sentence stands in
    for every part that cannot be shown. Raises `ConfigError` where poses need `data.action_hz`.
    """
    overview = survey_recordings(opened, params)
    summaries, chosen = overview.summaries, overview.choose(params.inspect.episodes)

    @lru_cache(maxsize=1)
    def view_of(index: int) -> EpisodeView:
        return view_episode(opened.recordings[index], params.data, overview.rotation)

    def drawer(index: int, prefix: str) -> Draw:
        # The view is read again when a picture is drawn: a long page holds one in memory.
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
    return Report(f"Recordings: {name}", summary, _tiles(overview), sections)


def _tiles(overview: RecordingsOverview) -> list[tuple[str, str]]:
    summaries, issues = overview.summaries, overview.issues
    errors = sum(issue.severity == "error" for issue in issues)
    return [
        ("episodes", f"{len(summaries):,}"),
        ("recorded", duration(sum(summary.duration_s for summary in summaries))),
        ("ticks", f"{sum(summary.ticks for summary in summaries):,}"),
        ("VL rows", f"{sum(summary.vl_rows for summary in summaries):,}"),
        ("cameras", f"{len(overview.views)}"),
        ("errors", f"{errors:,}"),
        ("warnings", f"{len(issues) - errors:,}"),
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
    overview: RecordingsOverview, index: int, view: EpisodeView, draw: Draw, params: Params
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
