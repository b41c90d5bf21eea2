"""Every recording looked over, one in memory at a time."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b
from pathlib import Path

import numpy as np
from tqdm import tqdm

from pipeline.base.config import Params
from pipeline.base.errors import StoreMismatch
from pipeline.data import Opened, Recording
from pipeline.data.embodiment import Embodiment, common_embodiment
from pipeline.data.timeline import ActionRotation, choose_action_rotation, rate_notes
from pipeline.look.recording.episodes import view_episode
from pipeline.look.recording.facts import EpisodeView, Flaw
from pipeline.look.recording.flaws import find_flaws


@dataclass(frozen=True)
class EpisodeSummary:
    """One episode in a line."""

    source: str
    episode: str
    format: str
    path: Path
    instruction: str | None
    zero: float
    """The first instant of all clocks, which times of flaws are shown from."""
    duration_s: float
    ticks: int
    vl_rows: int
    frames: Mapping[str, int]
    """By view."""
    readings: int
    """Of the sensor; 0 without one."""
    states: int
    errors: int
    warnings: int


@dataclass(frozen=True)
class RecordingsOverview:
    """All recordings that were opened, and what is wrong with any of them."""

    summaries: tuple[EpisodeSummary, ...]
    """One a recording, in the order in which they were opened."""
    flaws: tuple[Flaw, ...]
    """Of the sources as a whole and of what could not be opened, then episode by episode."""
    rotation: ActionRotation
    """What `data.action_rotation` means for these recordings."""
    views: tuple[str, ...]
    """Of any recording, sorted."""

    def flaws_of(self, summary: EpisodeSummary) -> tuple[Flaw, ...]:
        """The flaws of one episode."""
        wanted = (summary.source, summary.episode)
        return tuple(flaw for flaw in self.flaws if (flaw.source, flaw.episode) == wanted)

    def chosen(self, count: int) -> tuple[int, ...]:
        """At most `count` places in `summaries` to look at closely, in their order.

        Those with most errors, then most warnings, come first; the others are evenly spread.
        """
        worst = sorted(
            (place for place, one in enumerate(self.summaries) if one.errors or one.warnings),
            key=lambda place: (-self.summaries[place].errors, -self.summaries[place].warnings),
        )[:count]
        sound = [place for place in range(len(self.summaries)) if place not in worst]
        left = min(count - len(worst), len(sound))
        spread = np.linspace(0, len(sound) - 1, left).round().astype(int).tolist() if left else []
        return tuple(sorted([*worst, *(sound[place] for place in spread)]))


def survey_recordings(opened: Opened, params: Params) -> RecordingsOverview:
    """Every recording read and checked, with a progress bar; none is kept.

    What could not be opened, what `meta/` lists and is not there, what episodes lack that most of
    their source have, and channels that do not fit together are among the flaws. Raises
    `ConfigError` where poses need `data.action_hz`.
    """
    rotation = choose_action_rotation(params.data.action_rotation, opened.recordings)
    summaries: list[EpisodeSummary] = []
    flaws: list[tuple[Flaw, ...]] = []
    embodiments: list[tuple[Recording, Embodiment]] = []
    held: list[frozenset[str]] = []
    digests: list[dict[str, str]] = []
    rates: list[tuple[str, float | None, float]] = []
    for recording in tqdm(opened.recordings, "inspecting", unit="episode", disable=None):
        view = view_episode(recording, params.data, rotation)
        flaws.append(find_flaws(view))
        summaries.append(_summary(view))
        held.append(frozenset(view.clocks))
        digests.append(_motion_digests(view))
        if view.timeline is not None:
            line = view.timeline
            found = Embodiment.of(line.action_channels, line.action_kind, view.sensor, view.state)
            embodiments.append((recording, found))
            rates.append((recording.source, line.recorded_hz, line.fastest_hz))
    for place, lacking in _lacking(summaries, held):
        flaws[place] = (*flaws[place], *_missing(summaries[place], lacking, flaws[place]))
    for place, flaw in _duplicates(summaries, digests):
        flaws[place] = (*flaws[place], flaw)
    counted = [_counted(one, found) for one, found in zip(summaries, flaws, strict=True)]
    return RecordingsOverview(
        summaries=tuple(counted),
        flaws=(
            *_not_opened(opened),
            *_apart(embodiments),
            *_other_rate(rates, params.data.action_hz),
            *(one for each in flaws for one in each),
        ),
        rotation=rotation,
        views=tuple(sorted({view for one in summaries for view in one.frames})),
    )


def _summary(view: EpisodeView) -> EpisodeSummary:
    one, line = view.recording, view.timeline
    return EpisodeSummary(
        source=one.source,
        episode=one.id,
        format=one.format,
        path=one.path,
        instruction=view.instruction,
        zero=view.zero,
        duration_s=view.duration_s,
        ticks=0 if line is None else len(line.time),
        vl_rows=0 if line is None else len(line.vl_time),
        frames={name: len(camera.time) for name, camera in view.cameras.items()},
        readings=0 if view.sensor is None else len(view.sensor.time),
        states=0 if view.state is None else len(view.state.time),
        errors=0,
        warnings=0,
    )


def _counted(summary: EpisodeSummary, flaws: Sequence[Flaw]) -> EpisodeSummary:
    errors = sum(flaw.severity == "error" for flaw in flaws)
    return replace(summary, errors=errors, warnings=len(flaws) - errors)


def _lacking(
    summaries: Sequence[EpisodeSummary], held: Sequence[frozenset[str]]
) -> Iterator[tuple[int, list[str]]]:
    """Places of episodes without what most of their source's episodes of that format have."""
    alike: dict[tuple[str, str], list[int]] = defaultdict(list)
    for place, one in enumerate(summaries):
        alike[one.source, one.format].append(place)
    for places in alike.values():
        every = set().union(*(held[place] for place in places))
        usual = {
            name for name in every if 2 * sum(name in held[place] for place in places) > len(places)
        }
        for place in places:
            if lacking := sorted(usual - held[place]):
                yield place, lacking


def _missing(
    summary: EpisodeSummary, lacking: Sequence[str], flaws: Sequence[Flaw]
) -> Iterator[Flaw]:
    """One flaw for what is not there and has no flaw that says why."""
    told = {name for flaw in flaws for name in flaw.stream.split(", ")}
    if "cameras" in told:
        told |= {name for name in lacking if name.startswith("view ")}
    if "state" in told:
        told.add("poses")  # its columns
    if names := [name for name in lacking if name not in told]:
        yield Flaw(
            "missing",
            "warning",
            summary.source,
            summary.episode,
            ", ".join(names),
            None,
            None,
            "not there; most episodes of this source have it",
        )


def _motion_digests(view: EpisodeView) -> dict[str, str]:
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


def _duplicates(
    summaries: Sequence[EpisodeSummary], digests: Sequence[Mapping[str, str]]
) -> Iterator[tuple[int, Flaw]]:
    """Places of episodes that were there before, with a flaw that names the first.

    They agree in every digest that both have, and in one at least.
    """
    firsts: dict[tuple[str, str], list[int]] = defaultdict(list)
    for place, (one, motion) in enumerate(zip(summaries, digests, strict=True)):
        alike = sorted({first for digest in motion.items() for first in firsts[digest]})
        for first in alike:
            common = sorted(motion.keys() & digests[first].keys(), reverse=True)
            if all(motion[name] == digests[first][name] for name in common):
                yield place, _duplicate(one, summaries[first], common)
                break
        else:
            for digest in motion.items():
                firsts[digest].append(place)


def _duplicate(one: EpisodeSummary, other: EpisodeSummary, common: Sequence[str]) -> Flaw:
    source = "" if other.source == one.source else f"{other.source}/"
    message = (
        f"the same recording as {source}{other.episode} ({other.path}): all values of "
        f"{' and '.join(common)} are equal, and nothing else was compared; it would count twice. "
        "Leave one of them out of data.sources"
    )
    return Flaw(
        "duplicate recording", "warning", one.source, one.episode, "episode", None, None, message
    )


def _not_opened(opened: Opened) -> Iterator[Flaw]:
    for one in opened.bad:
        where = one.where.name
        yield Flaw("unreadable", "error", one.source, where, "episode", None, None, one.reason)
    by_source: dict[str, list[str]] = defaultdict(list)
    for line in opened.missing:
        source, _, said = line.partition(": ")
        by_source[source].append(said)
    for source, lines in by_source.items():
        more = f" ({len(lines)} such episodes in all)" if len(lines) > 1 else ""
        said = f"{lines[0]}{more}"
        yield Flaw("missing", "warning", source, "", "episode", None, None, said)


def _other_rate(
    rates: Sequence[tuple[str, float | None, float]], action_hz: float | None
) -> Iterator[Flaw]:
    """A flaw a source whose ticks are not the recorded rows."""
    for source, note in rate_notes(rates, action_hz).items():
        said = f"{note}; with data.action_hz null the recorded rows are the ticks"
        yield Flaw("tick rate", "warning", source, "", "ticks", None, None, said)


def _apart(embodiments: Sequence[tuple[Recording, Embodiment]]) -> Iterator[Flaw]:
    """A flaw where the recordings cannot stand in one store."""
    if not embodiments:
        return
    try:
        common_embodiment(embodiments, "store", "Inspect and extract them apart.")
    except StoreMismatch as error:
        yield Flaw("embodiment", "error", "", "", "episode", None, None, str(error))
