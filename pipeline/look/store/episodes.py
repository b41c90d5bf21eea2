"""What each episode of a store has: how long it is, which streams and views its ticks see."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from pipeline.base.issue import Issue, Severity
from pipeline.base.table import Table
from pipeline.look.page.blocks import Block
from pipeline.look.page.style import shorten_middle
from pipeline.store import Episode, FeatureStore, episode_name

ROWS = 100
"""Episodes in the table of all; of more, the first."""
FEW_TICKS = 10
_GAP_STEPS = 5
_RARE, _USUAL = 0.05, 0.8
_LINE = "#222222"
"""Between sources: a map is light on a dark page too, where ink is white."""
_NAMED_EPISODES = 16


@dataclass(frozen=True)
class EpisodeCoverage:
    """One episode: how long it is, and which streams it has for how much of it."""

    episode: Episode
    seconds: float
    """From the first tick to the last."""
    covered: Mapping[str, float]
    """`sensor`, `state`, and each view -> share of the episode's ticks that see it, 0 to 1."""

    @property
    def name(self) -> str:
        """`source/id`."""
        return episode_name(self.episode)

    @property
    def ticks(self) -> slice:
        """Of the store's ticks."""
        return slice(self.episode.ticks.start, self.episode.ticks.stop)

    def issue(
        self, kind: str, stream: str, message: str, *span: float, severity: Severity = "warning"
    ) -> Issue:
        """An issue of this episode; `span` is its start and stop in s since the first tick."""
        start_s, stop_s = map(float, span) if span else (None, None)
        return Issue(
            severity=severity, kind=kind, message=message, start_s=start_s, stop_s=stop_s,
            source=self.episode.source, episode=self.episode.id, stream=stream,
        )  # fmt: skip


def read_coverage(store: FeatureStore, episode: Episode) -> EpisodeCoverage:
    """What an episode's ticks see."""
    ticks = slice(episode.ticks.start, episode.ticks.stop)
    time = store.array("tick/time")[ticks]
    seen = {
        "sensor": store.array("tick/sensor_end")[ticks] > episode.readings.start,
        "state": store.array("tick/state_end")[ticks] > episode.states.start,
    }
    shown = np.isfinite(store.array("vl/frame_time")[store.array("tick/vl_row")[ticks]])
    seen |= dict(zip(store.streams["views"], shown.T, strict=True))
    if not len(time):
        return EpisodeCoverage(episode, 0.0, dict.fromkeys(seen, 0.0))
    covered = {name: float(there.mean()) for name, there in seen.items()}
    return EpisodeCoverage(episode, float(np.ptp(time)), covered)


def show_coverage(episodes: Sequence[EpisodeCoverage]) -> list[Block]:
    """A row a source, and a row an episode."""
    caption = "Ticks see all streams and views, none of one (no …), or one in a share of them."
    if len(episodes) > ROWS:
        caption += f" The first {ROWS} of {len(episodes)} episodes."
    heads = ("source", "episode", "instruction", "ticks", "length [s]", "VL rows", "ticks see")
    rows: list[tuple[object, ...]] = []
    for part in episodes[:ROWS]:
        own = part.episode
        counts = len(own.ticks), round(part.seconds, 2), len(own.vl_rows)
        rows.append((own.source, own.id, own.instruction, *counts, _lacking(part.covered)))
    return [_tabulate_sources(episodes), Table(heads, rows, caption)]


def _tabulate_sources(episodes: Sequence[EpisodeCoverage]) -> Table:
    """A row a source."""
    parts: dict[str, list[EpisodeCoverage]] = defaultdict(list)
    for episode in episodes:
        parts[episode.episode.source].append(episode)
    rows: list[tuple[object, ...]] = []
    for name, part in parts.items():
        own = [coverage.episode for coverage in part]
        seconds = round(sum(coverage.seconds for coverage in part), 1)
        kinds = ("ticks", "vl_rows", "readings", "states")
        counts = [sum(len(getattr(episode, kind)) for episode in own) for kind in kinds]
        formats = ", ".join(sorted({episode.format for episode in own}))
        instructions = len({episode.instruction for episode in own})
        rows.append((name, formats, instructions, len(own), seconds, *counts))
    heads = ("source", "format", "instructions", "episodes", "length [s]", "ticks", "VL rows")
    return Table((*heads, "sensor readings", "state readings"), rows)


def _lacking(covered: Mapping[str, float]) -> str:
    """What not all ticks see; a partial share is never rounded to all or none."""
    lacking = [
        f"{min(max(share, 0.01), 0.99):.0%} {name}" if share else f"no {name}"
        for name, share in covered.items()
        if share < 1
    ]
    return ", ".join(lacking) or "all"


def mark_sources(axis: Axes, episodes: Sequence[EpisodeCoverage]) -> None:
    """Sources below an axis of episodes, parted by lines; the episodes' names where few."""
    sources = [episode.episode.source for episode in episodes]
    starts = [at for at, source in enumerate(sources) if not at or source != sources[at - 1]]
    for start in starts[1:]:
        axis.axvline(start - 0.5, color=_LINE, lw=1.0)
    if len(episodes) <= _NAMED_EPISODES:
        names = [part.episode.id if len(starts) == 1 else part.name for part in episodes]
        # Both ends: where it belongs, and what tells it from its neighbours.
        names = [shorten_middle(name, 6, 15) for name in names]
        axis.set_xticks(range(len(episodes)), names, rotation=45, ha="right")
        return
    counts = np.diff([*starts, len(episodes)])
    labels = [f"{sources[start]}\n{count}" for start, count in zip(starts, counts, strict=True)]
    axis.set_xticks(starts + (counts - 1) / 2, labels)
    axis.set_xlabel("episodes, by source")


def find_episode_issues(
    store: FeatureStore, episodes: Sequence[EpisodeCoverage]
) -> Iterator[Issue]:
    """Gaps, short episodes, missing streams and views, instructions that stand out."""
    there = {name for episode in episodes for name, share in episode.covered.items() if share}
    for episode in episodes:
        time = store.array("tick/time")[episode.ticks]
        steps = np.diff(time)
        usual = float(np.median(steps)) if len(steps) else 0.0
        gaps = np.flatnonzero(steps > _GAP_STEPS * usual)
        if usual > 0 and len(gaps):
            at = int(steps.argmax())
            text = f"{len(gaps)} gap(s), the widest {steps[at]:.2f} s; usual is {usual:.3f} s"
            yield episode.issue("gap", "ticks", text, *time[[at, at + 1]] - time[0])
        if len(time) < FEW_TICKS:
            text = f"{len(time)} ticks ({episode.seconds:.1f} s); expected at least {FEW_TICKS}"
            yield episode.issue("short episode", "ticks", text)
        # An episode without a tick has no stream to miss.
        for name, share in episode.covered.items() if len(time) else ():
            stream = name if name in ("sensor", "state") else f"view {name}"
            if name in there and not share:
                yield episode.issue("missing", stream, "no tick sees it; other episodes have it")
            elif 0 < share < 1:
                text = f"only {share:.0%} of the ticks see it"
                yield episode.issue("partly missing", stream, text)
    yield from _instructions(episodes)


def _instructions(episodes: Sequence[EpisodeCoverage]) -> Iterator[Issue]:
    """No instruction, or one that stands out in its source."""
    by_source: dict[str, Counter[str]] = defaultdict(Counter)
    for episode in episodes:
        by_source[episode.episode.source][episode.episode.instruction] += 1
    usual = {name: (*said.most_common(1)[0], said.total()) for name, said in by_source.items()}
    for episode in episodes:
        source, words = episode.episode.source, episode.episode.instruction
        most, often, total = usual[source]
        rare = by_source[source][words] <= max(1, _RARE * total) < often
        if not words.strip():
            text = "the prompt says nothing of the task; set `instruction` of its data source"
            yield episode.issue("no instruction", "instruction", text)
        elif rare and often >= _USUAL * total:
            text = f"{words!r}; {often} of {total} episodes of this source say {most!r}"
            yield episode.issue("other instruction", "instruction", text)
