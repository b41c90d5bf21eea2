"""Recordings -> their page: all in a table, what looks wrong, some of them in every detail."""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial

from matplotlib.figure import Figure

from pipeline.base.config import Params
from pipeline.base.format import duration
from pipeline.base.table import Table
from pipeline.data import Opened
from pipeline.look.page.blocks import Block, Issues, Picture, Report, Section, Text
from pipeline.look.recording.channels import statistics_blocks
from pipeline.look.recording.clocks import clock_blocks
from pipeline.look.recording.episode import EpisodeView, view_episode
from pipeline.look.recording.frames import camera_blocks
from pipeline.look.recording.model_input import prompt_blocks, sample_blocks
from pipeline.look.recording.overview import (
    EpisodeSummary,
    RecordingsOverview,
    survey_recordings,
    worst_first,
)
from pipeline.look.recording.streams import motion_blocks, sensor_blocks

# Title, what shows it, and the streams whose errors say why there is nothing to show.
_TOPICS = (
    ("Camera views", camera_blocks, {"cameras", "ticks"}),
    ("Sensor", sensor_blocks, {"sensor"}),
    ("Motion and actions", motion_blocks, {"state", "action"}),
    ("Clocks", clock_blocks, {"cameras", "state"}),
    ("Statistics by channel", statistics_blocks, {"state", "sensor"}),
)
# Episodes that the table of all shows at most: those with findings, then the first.
ROWS = 100


def recordings_report(opened: Opened, params: Params, name: str) -> Report:
    """The page of these recordings, which `name` is what a reader calls them.

    Every recording is read and checked, one in memory at a time; `inspect.episodes` of them are
    shown in detail. Pictures read their recording again when they are drawn. What cannot be shown
    is a sentence on the page. Raises `ConfigError` where poses need `data.action_hz`.
    """
    overview = survey_recordings(opened, params)
    summaries, chosen = overview.summaries, overview.choose(params.inspect.episodes)

    @lru_cache(maxsize=1)
    def view_of(index: int) -> EpisodeView:
        return view_episode(opened.recordings[index], params.data, overview.rotation)

    whole = f"all {len(summaries):,} episodes were" if len(summaries) > 1 else "the episode was"
    nothing = f"Nothing looks wrong: {whole} read and every check passed."
    # Of the episodes shown, the one with fewest errors that has ticks: what a model would get.
    model = min(chosen, key=lambda index: (not summaries[index].ticks, summaries[index].errors))
    draw = partial(_picture, "", partial(view_of, model))
    sections = [
        Section("What looks wrong", [Issues(overview.since_start(overview.issues), nothing)]),
        Section("Episodes", _episodes(overview, chosen)),
        *(
            _episode_section(overview, index, f"episode{place}-", partial(view_of, index), params)
            for place, index in enumerate(chosen, start=1)
        ),
        Section(
            "What the model and the policy get",
            [Text(f"Of the episode `{summaries[model].episode}`, under the params in force.")],
            [
                Section("Samples and batch", sample_blocks(view_of(model), draw, params)),
                Section("Prompt", prompt_blocks(view_of(model), params, overview.views)),
            ],
        ),
    ]
    return Report(f"Recordings: {name}", _summary(params), _tiles(overview), sections)


def _summary(params: Params) -> str:
    data = params.data
    rate = "the recorded rows" if data.action_hz is None else f"{data.action_hz:g} Hz"
    return (
        f"Ticks at {rate}, one VL row every {data.vlm_reuse_count} ticks. "
        "Times count from the first instant of an episode."
    )


def _tiles(overview: RecordingsOverview) -> list[tuple[str, str]]:
    summaries, issues = overview.summaries, overview.issues
    errors = sum(issue.severity == "error" for issue in issues)
    return [
        ("episodes", f"{len(summaries):,}"),
        ("recorded", duration(sum(one.duration_s for one in summaries))),
        ("ticks", f"{sum(one.ticks for one in summaries):,}"),
        ("VL rows", f"{sum(one.vl_rows for one in summaries):,}"),
        ("cameras", f"{len(overview.views)}"),
        ("errors", f"{errors:,}"),
        ("warnings", f"{len(issues) - errors:,}"),
    ]


def _episodes(overview: RecordingsOverview, chosen: Sequence[int]) -> list[Block]:
    summaries = overview.summaries
    shown = sorted({*chosen, *worst_first(summaries)[:ROWS]})
    source = ["source"] if _several(overview) else []
    heads = [
        *source, "episode", "errors", "warnings", "length [s]", "ticks", "VL rows", "frames",
        "readings", "states", "format", "instruction",
    ]  # fmt: skip
    rows = [[one.source][: len(source)] + _cells(one) for one in (summaries[at] for at in shown)]
    caption = "Those in bold are shown in detail below. Readings are the sensor's."
    if len(shown) < len(summaries):
        caption += (
            f" {len(shown)} of {len(summaries):,} episodes are listed, those with most findings "
            "among them; all were checked."
        )
    strong = frozenset(row for row, index in enumerate(shown) if index in chosen)
    return [Table(heads, rows, caption, strong)]


def _cells(one: EpisodeSummary) -> list[object]:
    readings, states = (one.counts.get(name, 0) for name in ("sensor", "state"))
    return [
        one.episode, one.errors, one.warnings, one.duration_s, one.ticks, one.vl_rows,
        _frames(one.frames), readings, states, one.format, one.instruction,
    ]  # fmt: skip


def _several(overview: RecordingsOverview) -> bool:
    return len({one.source for one in overview.summaries}) > 1


def _frames(counts: Mapping[str, int]) -> str:
    """`3 × 76` where three views have as many, else the count of each."""
    if len(set(counts.values())) == 1:
        return f"{len(counts)} × {next(iter(counts.values())):,}"
    # Unbroken between a view and its count.
    return ", ".join(f"{view}\u00a0{count:,}" for view, count in counts.items()) or "none"


def _episode_section(
    overview: RecordingsOverview,
    index: int,
    prefix: str,
    view_of: Callable[[], EpisodeView],
    params: Params,
) -> Section:
    """Everything of one episode; its pictures' names begin with `prefix`."""
    one, view = overview.summaries[index], view_of()
    plain = re.sub(r"[^A-Za-z0-9]+", "_", one.episode).strip("_")[-40:] or "episode"
    draw = partial(_picture, f"{prefix}{plain}-", view_of)
    blocks: list[Block] = [Text(f"`{one.path}`, format {one.format}: “{one.instruction or '–'}”")]
    if len(overview.summaries) > 1:
        listed = overview.since_start(one.issues)
        blocks.append(Issues(listed, "Nothing looks wrong in this episode."))
    return Section(
        f"{one.source} / {one.episode}" if _several(overview) else one.episode,
        blocks,
        [
            Section(title, blocks_of(view, draw, params) or [_absent(one, streams)])
            for title, blocks_of, streams in _TOPICS
        ],
    )


def _picture(
    prefix: str,
    view_of: Callable[[], EpisodeView],
    name: str,
    caption: str,
    draw: Callable[[EpisodeView], Figure],
) -> Picture:
    # The view is read again when the picture is drawn, so that a long page holds one in memory.
    return Picture(f"{prefix}{name}", caption, lambda: draw(view_of()))


def _absent(summary: EpisodeSummary, streams: set[str]) -> Text:
    """What an error says of streams that are not there, else that they were not recorded."""
    for issue in summary.issues:
        if issue.severity == "error" and streams & {*issue.stream.split(", ")}:
            return Text(f"Not shown. {issue.message}")
    return Text("This episode has nothing of this.")
