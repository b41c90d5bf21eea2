"""Recordings -> their page: all in a table, what looks wrong, some of them in every detail."""

from collections.abc import Mapping, Sequence
from functools import lru_cache, partial

from pipeline.base.config import Params
from pipeline.base.format import duration
from pipeline.data import Opened
from pipeline.look.page.blocks import Block, Issues, Report, Section, Table, Text
from pipeline.look.recording.episodes import view_episode
from pipeline.look.recording.overview import EpisodeSummary, RecordingsOverview, survey_recordings
from pipeline.look.recording.page_episode import Viewer, episode_section
from pipeline.look.recording.page_flaws import notices
from pipeline.look.recording.page_model_input import model_input

ROWS = 100
"""Episodes that the table of all shows at most: those with findings, then the first."""


def recordings_report(opened: Opened, params: Params, name: str) -> Report:
    """The page of these recordings, which `name` is what a reader calls them.

    Every recording is read and checked, one in memory at a time; `inspect.episodes` of them are
    shown in detail. Pictures read their recording again when they are drawn. What cannot be shown
    is a sentence on the page. Raises `ConfigError` where poses need `data.action_hz`.
    """
    overview = survey_recordings(opened, params)
    chosen = overview.chosen(params.inspect.episodes)
    view_of: Viewer = lru_cache(maxsize=1)(
        lambda index: view_episode(opened.recordings[index], params.data, overview.rotation)
    )
    several = len({one.source for one in overview.summaries}) > 1
    sections = [
        Section("What looks wrong", [_notices(overview)]),
        Section("Episodes", _episodes(overview.summaries, chosen, several)),
        *(
            episode_section(
                overview.summaries[index],
                number_of_section,
                partial(view_of, index),
                overview.flaws_of(overview.summaries[index]),
                params.inspect,
                several,
                len(overview.summaries) == 1,
            )
            for number_of_section, index in enumerate(chosen, start=1)
        ),
        model_input(_clean_first(overview, chosen), view_of, overview, params),
    ]
    return Report(f"Recordings: {name}", _summary(params), _tiles(overview), sections)


def zeros(overview: RecordingsOverview) -> dict[tuple[str, str], float]:
    """The instant from which an episode's times count, by source and episode."""
    return {(one.source, one.episode): one.zero for one in overview.summaries}


def _notices(overview: RecordingsOverview) -> Issues:
    count = len(overview.summaries)
    whole = "the episode was" if count == 1 else f"all {count:,} episodes were"
    return Issues(
        notices(overview.flaws, zeros(overview)),
        f"Nothing looks wrong: {whole} read and every check passed.",
    )


def _summary(params: Params) -> str:
    data = params.data
    rate = "the recorded rows" if data.action_hz is None else f"{data.action_hz:g} Hz"
    return (
        f"Ticks at {rate}, one VL row every {data.vlm_reuse_count} ticks. "
        "Times count from the first instant of an episode."
    )


def _tiles(overview: RecordingsOverview) -> list[tuple[str, str]]:
    all_of = overview.summaries
    errors = sum(flaw.severity == "error" for flaw in overview.flaws)
    return [
        ("episodes", f"{len(all_of):,}"),
        ("recorded", duration(sum(one.duration_s for one in all_of))),
        ("ticks", f"{sum(one.ticks for one in all_of):,}"),
        ("VL rows", f"{sum(one.vl_rows for one in all_of):,}"),
        ("cameras", f"{len(overview.views)}"),
        ("errors", f"{errors:,}"),
        ("warnings", f"{len(overview.flaws) - errors:,}"),
    ]


def _episodes(
    summaries: Sequence[EpisodeSummary], chosen: Sequence[int], several: bool
) -> list[Block]:
    wanted = sorted(
        range(len(summaries)), key=lambda i: (-summaries[i].errors, -summaries[i].warnings)
    )
    shown = sorted({*chosen, *wanted[:ROWS]})
    heads = [
        *(["source"] if several else []), "episode", "errors", "warnings", "length [s]", "ticks",
        "VL rows", "frames", "readings", "states", "format", "instruction",
    ]  # fmt: skip
    rows = [_line(summaries[index], several) for index in shown]
    strong = frozenset(row for row, index in enumerate(shown) if index in chosen)
    said = "Those in bold are shown in detail below. Readings are the sensor's."
    blocks: list[Block] = [Table(heads, rows, said, strong)]
    if len(shown) < len(summaries):
        blocks.append(
            Text(
                f"{len(shown)} of {len(summaries):,} episodes are listed, those with most findings "
                "among them; all were checked."
            )
        )
    return blocks


def _line(one: EpisodeSummary, several: bool) -> list[object]:
    return [
        *([one.source] if several else []), one.episode, one.errors, one.warnings, one.duration_s,
        one.ticks, one.vl_rows, _frames(one.frames), one.readings, one.states, one.format,
        one.instruction,
    ]  # fmt: skip


def _frames(counts: Mapping[str, int]) -> str:
    """`3 × 76` where three views have as many, else the count of each."""
    if len(set(counts.values())) == 1:
        return f"{len(counts)} × {next(iter(counts.values())):,}"
    # Unbroken between a view and its count.
    return ", ".join(f"{view}\u00a0{count:,}" for view, count in counts.items()) or "none"


def _clean_first(overview: RecordingsOverview, chosen: Sequence[int]) -> int:
    """Of the episodes shown, the one with fewest errors that has ticks: what a model would get."""
    return min(
        chosen, key=lambda i: (overview.summaries[i].ticks == 0, overview.summaries[i].errors)
    )
