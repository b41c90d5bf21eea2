"""Flaws -> issues as the page counts time: from the first instant of their episode."""

from collections.abc import Mapping, Sequence

from pipeline.base.issue import Issue
from pipeline.look.recording.facts import Flaw


def notices(flaws: Sequence[Flaw], zeros: Mapping[tuple[str, str], float]) -> list[Issue]:
    """`zeros` has, by source and episode, the instant from which pictures count time."""
    return [_issue(flaw, zeros.get((flaw.source, flaw.episode), 0.0)) for flaw in flaws]


def _issue(flaw: Flaw, zero: float) -> Issue:
    start, stop = (None if at is None else at - zero for at in (flaw.start_s, flaw.stop_s))
    return Issue(
        severity=flaw.severity,
        kind=flaw.kind,
        message=flaw.message,
        source=flaw.source,
        episode=flaw.episode,
        stream="" if flaw.stream == "episode" else flaw.stream,
        start_s=start,
        stop_s=stop,
    )
