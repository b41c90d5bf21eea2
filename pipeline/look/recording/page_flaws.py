"""Flaws -> notices: the same flaw in many episodes is one, with a count and all its places."""

from collections import defaultdict
from collections.abc import Mapping, Sequence

from pipeline.look.page.blocks import Notice, Place
from pipeline.look.recording.facts import Flaw


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


def _notice(group: Sequence[Flaw], zeros: Mapping[tuple[str, str], float], several: bool) -> Notice:
    first = group[0]
    episodes = len({(flaw.source, flaw.episode) for flaw in group})
    places = tuple(_place(flaw, zeros, several) for flaw in group)
    stream = "" if first.stream == "episode" else first.stream
    count = str(places[0]) if len(group) == 1 else _count(len(group), episodes)
    where = " · ".join(part for part in (stream, count) if part)
    return Notice(first.severity, first.kind, where, first.message, places)


def _count(places: int, episodes: int) -> str:
    among = "1 episode" if episodes == 1 else f"{episodes:,} episodes"
    return among if places == episodes else f"{places:,} places in {among}"


def _place(flaw: Flaw, zeros: Mapping[tuple[str, str], float], several: bool) -> Place:
    episode = f"{flaw.source}/{flaw.episode}" if several and flaw.episode else flaw.episode
    zero = zeros.get((flaw.source, flaw.episode), 0.0)
    start, stop = (None if at is None else at - zero for at in (flaw.start_s, flaw.stop_s))
    return Place(episode or flaw.source, flaw.stream, start, stop, flaw.message)
