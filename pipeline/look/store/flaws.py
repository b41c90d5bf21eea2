"""What looks wrong in the episodes of a store: clocks, ages, missing streams, instructions."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.base.issue import Issue as Flaw
from pipeline.data.timeline import COARSEST_S
from pipeline.look.recording.channels import ChannelStatistics
from pipeline.look.store.coverage import Ages, EpisodeCoverage
from pipeline.look.store.statistics import StreamStatistics
from pipeline.store import FeatureStore

FEW_TICKS = 10
_STALE_PERIODS = 2
_GAP_STEPS = 5
_RARE, _USUAL = 0.05, 0.8
_NAMED = 4
_NOISE = 0.01
"""Of the median standard deviation of the channels of a unit: what varies less is noise."""
_COMPARED = 3
"""Channels of one unit at least, for their median to say what is usual."""


def episode_flaws(
    store: FeatureStore,
    episodes: Sequence[EpisodeCoverage],
    ages: Ages,
    statistics: Sequence[StreamStatistics],
) -> Iterator[Flaw]:
    """All but those of features; times are s since the episode's first tick."""
    for one, each in zip(episodes, store.episodes, strict=True):
        ticks = slice(each.ticks.start, each.ticks.stop)
        time = store.array("tick/time")[ticks]
        if len(time):
            yield from _clock(one, time - time[0])
            yield from _age(one, time - time[0], ages.newest[ticks], ages.period_s)
        yield from _short(one)
    yield from _missing(episodes)
    yield from _instructions(episodes)
    yield from _constant(statistics)
    yield from _not_finite(statistics)
    yield from _still(statistics)
    yield from _noise(statistics)


def flaw_of(
    one: EpisodeCoverage,
    kind: str,
    stream: str,
    message: str,
    span: tuple[float | None, float | None] = (None, None),
    *,
    error: bool = False,
) -> Flaw:
    """A flaw of an episode, all of it where no `span` is given."""
    return Flaw(
        kind=kind,
        severity="error" if error else "warning",
        source=one.source,
        episode=one.id,
        stream=stream,
        start_s=span[0],
        stop_s=span[1],
        message=message,
    )


def listed(names: Sequence[str]) -> str:
    """The first few names, and how many more."""
    said = ", ".join(names[:_NAMED])
    return said if len(names) <= _NAMED else f"{said} and {len(names) - _NAMED} more"


def _clock(one: EpisodeCoverage, time: NDArray[np.float64]) -> Iterator[Flaw]:
    """The first jump back and the widest gap of an episode's ticks."""
    steps = np.diff(time)
    if not len(steps):
        return
    if steps.min() <= 0:
        at = int((steps <= 0).argmax())
        found = f"from {time[at]:.3f} s to {time[at + 1]:.3f} s; expected time to ascend"
        span = (float(time[at]), float(time[at + 1]))
        yield flaw_of(one, "clock jump", "ticks", found, span, error=True)
    usual, at = float(np.median(steps)), int(steps.argmax())
    if steps[at] > _GAP_STEPS * usual > 0:
        count = int((steps > _GAP_STEPS * usual).sum())
        found = f"{count} gap{'s' * (count > 1)}, the widest {steps[at]:.2f} s without a tick; "
        span = (float(time[at]), float(time[at + 1]))
        yield flaw_of(one, "gap", "ticks", f"{found}a step is usually {usual:.3f} s", span)


def _age(
    one: EpisodeCoverage, time: NDArray[np.float64], age: NDArray[np.float32], period_s: float
) -> Iterator[Flaw]:
    ahead = np.flatnonzero(age < -COARSEST_S)
    if len(ahead):
        found = f"{len(ahead)} ticks see a frame taken after them, by up to {-age.min():.3f} s"
        span = (float(time[ahead[0]]), float(time[ahead[-1]]))
        yield flaw_of(one, "frames from the future", "vl/frame_time", found, span, error=True)
    limit = _STALE_PERIODS * period_s
    old = np.flatnonzero(age > limit)
    if len(old):
        found = f"{len(old)} of {len(age)} ticks see features up to {age.max():.2f} s old; "
        found += f"expected less than {limit:.2f} s, the time of {_STALE_PERIODS} VL rows"
        span = (float(time[old[0]]), float(time[old[-1]]))
        yield flaw_of(one, "old frames", "vl/frame_time", found, span)


def _short(one: EpisodeCoverage) -> Iterator[Flaw]:
    if one.ticks < FEW_TICKS:
        found = f"{one.ticks} ticks ({one.seconds:.1f} s); expected at least {FEW_TICKS}"
        yield flaw_of(one, "short episode", "ticks", found)


def _missing(episodes: Sequence[EpisodeCoverage]) -> Iterator[Flaw]:
    """Streams and views that some episodes have and others do not, a flaw a source."""
    by_source: dict[str, list[EpisodeCoverage]] = defaultdict(list)
    for one in episodes:
        if one.ticks:
            by_source[one.source].append(one)
    streams = [name for one in episodes for name, share in one.covered.items() if share]
    for stream in dict.fromkeys(streams):
        for source, ones in by_source.items():
            lacking = [one.id for one in ones if not one.covered[stream]]
            if lacking:
                found = f"{len(lacking)} of {len(ones)} episodes of this source lack it; others of "
                found += "the store have it"
                yield Flaw(
                    kind="missing",
                    severity="warning",
                    source=source,
                    episode=listed(lacking),
                    stream=_stream(stream),
                    message=found,
                )
            for one in ones:
                if 0 < one.covered[stream] < 1:
                    found = f"only {one.covered[stream]:.0%} of the ticks see it"
                    yield flaw_of(one, "partly missing", _stream(stream), found)


def _stream(name: str) -> str:
    return name if name in ("sensor", "state") else f"view {name}"


def _instructions(episodes: Sequence[EpisodeCoverage]) -> Iterator[Flaw]:
    """No instruction, or one that stands out in its source."""
    said: dict[str, Counter[str]] = defaultdict(Counter)
    for one in episodes:
        said[one.source][one.instruction] += 1
    most = {source: (*counts.most_common(1)[0], counts.total()) for source, counts in said.items()}
    for one in episodes:
        usual, often, total = most[one.source]
        rare = said[one.source][one.instruction] <= max(1, _RARE * total) < often
        if not one.instruction.strip():
            found = "the prompt says nothing of the task; set `instruction` of its data source"
            yield flaw_of(one, "no instruction", "instruction", found)
        elif rare and often >= _USUAL * total:
            found = f"{one.instruction!r}; {often} of {total} episodes of this source say {usual!r}"
            yield flaw_of(one, "other instruction", "instruction", found)


def _constant(statistics: Sequence[StreamStatistics]) -> Iterator[Flaw]:
    """Channels that never change; the gripper of pose-derived actions is 1 by definition."""
    for stream in statistics:
        still = [
            one.name
            for one in stream.channels
            if one.minimum == one.maximum and not (one.name == "gripper" and one.minimum == 1)
        ]
        if still:
            found = f"{listed(still)}: one value in all {stream.looked_at} rows looked at"
            yield Flaw(kind="flat channel", severity="warning", stream=stream.stream, message=found)


def _not_finite(statistics: Sequence[StreamStatistics]) -> Iterator[Flaw]:
    for stream in statistics:
        bad = [one.name for one in stream.channels if not np.isfinite(one.mean)]
        if bad:
            found = f"{listed(bad)}: NaN or infinite in the {stream.looked_at} rows looked at"
            yield Flaw(kind="not finite", severity="error", stream=stream.stream, message=found)


def _still(statistics: Sequence[StreamStatistics]) -> Iterator[Flaw]:
    for stream in statistics:
        if stream.still is not None:
            message = stream.still[1]
            yield Flaw(
                kind="still channel", severity="warning", stream=stream.stream, message=message
            )


def _noise(statistics: Sequence[StreamStatistics]) -> Iterator[Flaw]:
    """Other channels that vary far less than those of their unit, which normalising hides."""
    for stream in statistics:
        told = {stream.channels[at].name for at in stream.still[0]} if stream.still else set[str]()
        by_unit: dict[str, list[ChannelStatistics]] = defaultdict(list)
        for one in stream.channels:
            if one.unit and one.std > 0:
                by_unit[one.unit].append(one)
        for unit, ones in by_unit.items():
            usual = float(np.median([one.std for one in ones]))
            quiet = [one for one in ones if one.std < _NOISE * usual and one.name not in told]
            if quiet and len(ones) >= _COMPARED:
                most = max(one.std for one in quiet)
                found = f"{listed([one.name for one in quiet])}: standard deviation up to "
                found += f"{most:.2g} {unit}, under {_NOISE:.0%} of the median of this unit's "
                found += f"channels, {usual:.2g} {unit}; normalised, this noise weighs as much as "
                found += "their signal"
                yield Flaw(kind="noise", severity="warning", stream=stream.stream, message=found)
