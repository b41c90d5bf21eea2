"""Every recording looked over, one in memory at a time."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b
from pathlib import Path

import numpy as np
from tqdm import tqdm

from pipeline.base.config import Params
from pipeline.base.errors import StoreMismatch
from pipeline.base.issue import Issue
from pipeline.data import Opened, Recording
from pipeline.data.embodiment import Embodiment, common_embodiment
from pipeline.data.timeline import ActionRotation, choose_action_rotation, rate_notes
from pipeline.look.recording.episode import EpisodeView, view_episode
from pipeline.look.recording.issues import find_issues


@dataclass
class EpisodeSummary:
    """One episode in a line.

    `zero` is the first instant of all clocks, which times of issues are shown from; `counts` are
    entries by clock (`EpisodeView.clocks`), `digests` what its motion comes to (`_digest_motion`).
    """

    source: str
    episode: str
    format: str
    path: Path
    instruction: str | None
    zero: float
    duration_s: float
    ticks: int
    vl_rows: int
    counts: Mapping[str, int]
    digests: Mapping[str, str]
    issues: list[Issue]

    @property
    def frames(self) -> dict[str, int]:
        """How many there are by view."""
        views = {name: count for name, count in self.counts.items() if name.startswith("view ")}
        return {name.removeprefix("view "): count for name, count in views.items()}

    @property
    def errors(self) -> int:
        """How many of its issues are errors."""
        return sum(issue.severity == "error" for issue in self.issues)

    @property
    def warnings(self) -> int:
        """How many are not."""
        return len(self.issues) - self.errors

    def warn(self, kind: str, stream: str, message: str) -> None:
        """Add a warning."""
        source, episode = self.source, self.episode
        self.issues.append(_warning(kind, message, source, episode=episode, stream=stream))


@dataclass(frozen=True)
class RecordingsOverview:
    """All recordings that were opened, and what is wrong with any of them.

    `summaries` stand in the order in which recordings were opened; `common` are the issues of the
    sources as a whole and of what could not be opened; `rotation` is what `data.action_rotation`
    means for these recordings.
    """

    summaries: tuple[EpisodeSummary, ...]
    common: tuple[Issue, ...]
    rotation: ActionRotation

    @property
    def issues(self) -> tuple[Issue, ...]:
        """Those of all, then episode by episode."""
        return (*self.common, *(issue for one in self.summaries for issue in one.issues))

    @property
    def views(self) -> tuple[str, ...]:
        """Of any recording, sorted."""
        return tuple(sorted({view for one in self.summaries for view in one.frames}))

    def since_start(self, issues: Iterable[Issue]) -> list[Issue]:
        """The issues with times as a page counts them: from the first instant of their episode."""
        zeros = {(one.source, one.episode): one.zero for one in self.summaries}
        shifted: list[Issue] = []
        for issue in issues:
            zero = zeros.get((issue.source, issue.episode), 0.0)
            start_s, stop_s = (
                None if at is None else at - zero for at in (issue.start_s, issue.stop_s)
            )
            shifted.append(replace(issue, start_s=start_s, stop_s=stop_s))
        return shifted

    def choose(self, count: int) -> tuple[int, ...]:
        """At most `count` places in `summaries` to look at closely, in their order.

        Those with most errors, then most warnings, come first; the others are evenly spread.
        """
        ranked = worst_first(self.summaries)
        worst = [place for place in ranked if self.summaries[place].issues][:count]
        sound = [place for place in range(len(self.summaries)) if place not in worst]
        left = min(count - len(worst), len(sound))
        spread = np.linspace(0, len(sound) - 1, left).round().astype(int).tolist() if left else []
        return tuple(sorted([*worst, *(sound[place] for place in spread)]))


def worst_first(summaries: Sequence[EpisodeSummary]) -> list[int]:
    """Their places, those with most errors, then most warnings, first."""
    counts = [(-one.errors, -one.warnings) for one in summaries]
    return sorted(range(len(summaries)), key=counts.__getitem__)


def survey_recordings(opened: Opened, params: Params) -> RecordingsOverview:
    """Read and check every recording; none that is broken keeps another from being read.

    Raises `ConfigError` where poses need `data.action_hz`.
    """
    rotation = choose_action_rotation(params.data.action_rotation, opened.recordings)
    summaries: list[EpisodeSummary] = []
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
    _warn_of_duplicates(summaries)
    common = [*_not_opened(opened), *_apart(embodiments)]
    # Where ticks are not the recorded rows.
    for source, note in rate_notes(rates, params.data.action_hz).items():
        message = f"{note}; with data.action_hz null the recorded rows are the ticks"
        common.append(_warning("tick rate", message, source, stream="ticks"))
    return RecordingsOverview(tuple(summaries), tuple(common), rotation)


def _summarise(view: EpisodeView) -> EpisodeSummary:
    recording, line = view.recording, view.timeline
    return EpisodeSummary(
        source=recording.source,
        episode=recording.id,
        format=recording.format,
        path=recording.path,
        instruction=view.instruction,
        zero=view.zero,
        duration_s=view.duration_s,
        ticks=0 if line is None else len(line.time),
        vl_rows=0 if line is None else len(line.vl_time),
        counts={name: len(time) for name, time in view.clocks.items()},
        digests=_digest_motion(view),
        issues=list(find_issues(view)),
    )


def _warn_of_missing(summaries: Sequence[EpisodeSummary]) -> None:
    """Of what most of a source's episodes of that format have, and no issue says why it lacks."""
    alike: dict[tuple[str, str], list[EpisodeSummary]] = defaultdict(list)
    for one in summaries:
        alike[one.source, one.format].append(one)
    for group in alike.values():
        held = Counter(name for one in group for name in one.counts)
        usual = {name for name, count in held.items() if 2 * count > len(group)}
        for one in group:
            explained = {name for issue in one.issues for name in issue.stream.split(", ")}
            if "cameras" in explained:
                explained |= {name for name in usual if name.startswith("view ")}
            if "state" in explained:
                explained.add("poses")  # its columns
            if lacking := sorted(usual - one.counts.keys() - explained):
                message = "not there; most episodes of this source have it"
                one.warn("missing", ", ".join(lacking), message)


def _digest_motion(view: EpisodeView) -> dict[str, str]:
    """What the values of state and action come to, those of the sensor without either.

    Those that never change are left out: they can be equal by chance. Clocks are no part of it: two
    formats give the same rows other times.
    """
    motion = {name: view.streams[name] for name in ("state", "action") if name in view.streams}
    streams = motion or ({} if view.sensor is None else {"sensor": view.sensor})
    return {
        name: blake2b(stream.values.tobytes(), digest_size=16).hexdigest()
        for name, stream in streams.items()
        if np.ptp(stream.values, axis=0).any()
    }


def _warn_of_duplicates(summaries: Sequence[EpisodeSummary]) -> None:
    """Of episodes that were there before: they agree in all digests that both have, and in one."""
    firsts: dict[tuple[str, str], list[EpisodeSummary]] = defaultdict(list)
    for one in summaries:
        for first in (first for digest in one.digests.items() for first in firsts[digest]):
            common = sorted(one.digests.keys() & first.digests.keys(), reverse=True)
            if all(one.digests[name] == first.digests[name] for name in common):
                source = "" if first.source == one.source else f"{first.source}/"
                one.warn(
                    "duplicate recording",
                    "",
                    f"the same recording as {source}{first.episode} ({first.path}): all values of "
                    f"{' and '.join(common)} are equal, and nothing else was compared; it would "
                    "count twice. Leave one of them out of data.sources",
                )
                break
        else:
            for digest in one.digests.items():
                firsts[digest].append(one)


def _not_opened(opened: Opened) -> Iterator[Issue]:
    for bad in opened.bad:
        source, episode = bad.source, bad.where.name
        message = bad.reason
        yield Issue(
            severity="error", kind="unreadable", message=message, source=source, episode=episode
        )
    by_source: dict[str, list[str]] = defaultdict(list)
    for line in opened.missing:
        source, _, message = line.partition(": ")
        by_source[source].append(message)
    for source, messages in by_source.items():
        more = f" ({len(messages)} such episodes in all)" if len(messages) > 1 else ""
        yield _warning("missing", f"{messages[0]}{more}", source)


def _apart(embodiments: Sequence[tuple[Recording, Embodiment]]) -> Iterator[Issue]:
    """An issue where the recordings cannot stand in one store."""
    try:
        if embodiments:
            common_embodiment(embodiments, "store", "Inspect and extract them apart.")
    except StoreMismatch as error:
        yield Issue(severity="error", kind="embodiment", message=str(error))


def _warning(kind: str, message: str, source: str, episode: str = "", stream: str = "") -> Issue:
    return Issue(
        severity="warning", kind=kind, message=message,
        source=source, episode=episode, stream=stream,
    )  # fmt: skip
