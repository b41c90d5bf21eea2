"""Flaws -> notices: the same flaw in many episodes is one, with a count and the first places."""

from collections import defaultdict
from collections.abc import Mapping, Sequence

from pipeline.inspection.facts import Flaw
from pipeline.report.blocks import Notice

PLACES = 3
"""Of a flaw that stands in many, the first that are named."""


def notices(flaws: Sequence[Flaw], zeros: Mapping[tuple[str, str], float]) -> list[Notice]:
    """Flaws of one kind and stream as one notice; errors first, then what stands most often.

    `zeros` has, by source and episode, the instant from which pictures count time.
    """
    alike: dict[tuple[str, str, str], list[Flaw]] = defaultdict(list)
    for flaw in flaws:
        alike[flaw.severity, flaw.kind, flaw.stream].append(flaw)
    groups = sorted(alike.values(), key=lambda each: (each[0].severity != "error", -len(each)))
    several = len({flaw.source for flaw in flaws}) > 1
    return [_notice(group, zeros, several) for group in groups]


def when(flaw: Flaw, zero: float) -> str:
    """`3.20–4.10 s` since the first instant; nothing where it is all of the stream."""
    if flaw.start_s is None:
        return ""
    start = f"{flaw.start_s - zero:.2f}"
    stop = start if flaw.stop_s is None else f"{flaw.stop_s - zero:.2f}"
    return f"{start} s" if stop == start else f"{start}–{stop} s"


def _notice(group: Sequence[Flaw], zeros: Mapping[tuple[str, str], float], several: bool) -> Notice:
    first = group[0]
    episodes = len({(flaw.source, flaw.episode) for flaw in group})
    places = "; ".join(_place(flaw, zeros, several) for flaw in group[:PLACES])
    if len(group) > PLACES:
        places += f"; and {len(group) - PLACES} more"
    stream = "" if first.stream == "episode" else first.stream
    count = "" if len(group) == 1 else _count(len(group), episodes)
    where = " · ".join(part for part in (stream, count, places) if part)
    if len(group) == 1:
        return Notice(first.severity, first.kind, where, first.message)
    return Notice(first.severity, first.kind, where, f"The first: {first.message}")


def _count(places: int, episodes: int) -> str:
    among = "1 episode" if episodes == 1 else f"{episodes:,} episodes"
    return among if places == episodes else f"{places:,} places in {among}"


def _place(flaw: Flaw, zeros: Mapping[tuple[str, str], float], several: bool) -> str:
    episode = f"{flaw.source}/{flaw.episode}" if several and flaw.episode else flaw.episode
    time = when(flaw, zeros.get((flaw.source, flaw.episode), 0.0))
    return " ".join(part for part in (episode or flaw.source, time) if part)
