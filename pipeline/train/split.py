"""Which ticks are trained on, which choose the checkpoint and which are reported.

Whole groups of episodes fall on one side, in five steps:

1. `episodes_by_group` finds the episodes that must stay together.
2. `_ranks`: a hash of the seed and the group's name gives each group a number in [0, 1).
3. `_test_groups`: with folds, or with two groups, some groups are test whatever their rank.
4. `_ranges`: every other group takes the side whose range of ranks holds its own.
5. `_fill_empty_sides`: where few groups leave a side empty, the group of the nearest rank moves in.

Where one group is left after step 3, it is cut by time instead (`_cut_by_time`).
"""

import hashlib
from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import SplitParams
from pipeline.base.errors import ConfigError, StoreMismatch
from pipeline.base.provenance import SIDES, Side
from pipeline.store import Episode, FeatureStore, episode_name

_SHOWN = 5
"""Moved groups that a note lists."""

_SLACK_S = 1e-6
"""Times that differ by less count as equal: float64 seconds since 1970 are this coarse."""

_TOLERANCE, _RESTING = 1e-3, 0.1
"""How much two equal actions may differ in a channel, as a share of its range in the episode. A
channel at rest varies only by rounding, so its range counts as at least a tenth of the widest
channel's."""

Groups = Mapping[str, Sequence[Episode]]
"""Episodes so alike that a policy trained on one of them in effect knows the others, by name."""
Ranges = Mapping[Side, tuple[float, float]]
"""The ranks [low, high) of each side."""


@dataclass(frozen=True, eq=False)
class Split:
    """Ascending store-global ticks: to train on, to choose the checkpoint by, and to report on."""

    train: NDArray[np.int64]
    val: NDArray[np.int64]
    test: NDArray[np.int64]
    groups: Mapping[str, str]
    """"source/id" of each episode that has ticks -> its group."""
    note: str | None
    """What a reader of the metrics must know about this split, or None."""


def split_by_episode(store: FeatureStore, params: SplitParams, horizon: int = 8) -> Split:
    """The split of the store's episodes into whole groups, drawn as the module's docstring says.

    An added episode moves only its own group, unless a side was empty before or would be after.
    Every side with a share above 0 has a group of each source that has three or more groups, and a
    group of the store; a source of two groups has one to train on. With `folds`, each group is test
    in one fold, and `val` is drawn from the others. `params.train` keeps that many training groups,
    those of the lowest ranks.

    Of two groups one is test, and the tail of the other is val. A single group is cut by time into
    all three sides. Ticks whose chunk of `horizon` actions reaches into the next side are left out.

    Raises `StoreMismatch` where the store has no tick, and `ConfigError` where no training tick is
    left or there are fewer groups than folds.
    """
    groups = episodes_by_group(store, params.groups)
    if not groups:
        raise StoreMismatch(
            f"{store.path}: expected ticks to train on, found none. Look at data.sources and run "
            "stages.extract again."
        )
    shares: dict[Side, float] = {"test": params.test, "val": params.val}
    shares = {side: share for side, share in shares.items() if share > 0}
    ranks = _ranks(groups, f"{params.seed}")
    test = _test_groups(groups, ranks, params, shares)
    if test:
        shares.pop("test", None)
    rest = {name: group for name, group in groups.items() if name not in test}
    if len(rest) == 1:
        (group,) = rest.values()
        ticks, notes = _cut_by_time(store, group, shares, horizon)
        notes = [f"of {len(groups)} groups {len(test)} is test", *notes] if test else notes
    else:
        if params.folds is not None:
            ranks = _ranks(rest, f"{params.seed}.{params.fold}")
        ranges = _ranges(shares, len(rest) / len(groups))
        side_of: dict[str, Side] = {
            name: next(side for side, (_, high) in ranges.items() if ranks[name] < high)
            for name in rest
        }
        notes = _fill_empty_sides(side_of, ranks, ranges, _needs(groups, rest, tuple(ranges)))
        members = {side: [n for n in side_of if side_of[n] == side] for side in ranges}
        members["train"] = sorted(members["train"], key=ranks.__getitem__)[: params.train]
        ticks = {
            side: ticks_of([e for n in names for e in rest[n]]) for side, names in members.items()
        }
    if test:
        ticks["test"] = ticks_of([e for name in test for e in groups[name]])
    return Split(
        *(ticks.get(side, ticks_of([])) for side in SIDES),
        groups={episode_name(e): name for name, group in groups.items() for e in group},
        note="; ".join(notes) or None,
    )


def episodes_by_group(
    store: FeatureStore, patterns: Mapping[str, Sequence[str]] | None = None
) -> dict[str, list[Episode]]:
    """The episodes that have ticks, by group; a group is named by the first "source/id" in it.

    Two episodes share a group if their first VL keys, their files or their actions are equal, if
    their recordings name the same group, if `patterns` (shell wildcards for "source/id", by group
    name) of one group match both, or if both share a group with a third episode. Actions are equal
    if the episodes have the same number of ticks and agree within 0.1 % of their range, so a
    re-encoded copy is recognised. Actions that never change are not compared.

    Raises `ConfigError` if a pattern matches no episode.
    """
    from scipy.cluster.hierarchy import DisjointSet  # slow to import, not needed when finished

    episodes = [episode for episode in store.episodes if len(episode.ticks)]
    keys, frame_time = store.array("vl/key"), store.array("vl/frame_time")
    together, first = DisjointSet(range(len(episodes))), dict[Hashable, int]()
    for index, episode in enumerate(episodes):
        row = episode.vl_rows.start
        # Without a frame, a row's key depends on the instruction alone.
        key = keys[row].tobytes() if np.isfinite(frame_time[row]).any() else b""
        marks = [("key", key), ("content", episode.content), ("group", episode.group)]
        for mark in (mark for mark in marks if mark[1]):
            together.merge(first.setdefault(mark, index), index)
    for name, index in _fitting(patterns or {}, [episode_name(episode) for episode in episodes]):
        together.merge(first.setdefault(("params", name), index), index)
    for pair in _equal_actions(store.array("tick/action"), episodes):
        together.merge(*pair)
    groups = ([episodes[i] for i in sorted(members)] for members in together.subsets())
    return dict(sorted((min(map(episode_name, group)), group) for group in groups))


def _fitting(
    patterns: Mapping[str, Sequence[str]], names: Sequence[str]
) -> Iterator[tuple[str, int]]:
    """Yields (group, index in `names`) for each name that a pattern of the group matches."""
    for group, wanted in patterns.items():
        for pattern in wanted:
            places = [i for i, name in enumerate(names) if fnmatchcase(name, pattern)]
            if not places:
                raise ConfigError(
                    f"train_head.split.groups.{group}: expected patterns of episodes of the store, "
                    f"which are called {', '.join(names[:3])}{' …' if len(names) > 3 else ''}; "
                    f"{pattern!r} fits none of {len(names)}."
                )
            yield from ((group, place) for place in places)


def _equal_actions(
    action: NDArray[np.float32], episodes: Sequence[Episode]
) -> Iterator[tuple[int, int]]:
    """Yields the indices in `episodes` of each pair with equal actions (tick, action)."""
    by_length: dict[int, list[int]] = {}
    for index, episode in enumerate(episodes):
        by_length.setdefault(len(episode.ticks), []).append(index)
    for places in by_length.values():
        actions = [action[episodes[i].ticks.start : episodes[i].ticks.stop] for i in places]
        ranges = np.stack([np.ptp(own, axis=0) for own in actions])
        widest = ranges.max(axis=1, keepdims=True)
        tolerance = _TOLERANCE * np.maximum(ranges, _RESTING * widest)
        # First, mean and last action: cheap to compare, and equal where the actions are equal.
        outline = np.stack([[own[0], own.mean(axis=0, dtype=float), own[-1]] for own in actions])
        moving = np.flatnonzero((widest[:, 0] > 0) & (widest[:, 0] < np.inf))
        for rank, own in enumerate(moving):
            others = moving[rank + 1 :]
            allowed = np.maximum(tolerance[others], tolerance[own])
            alike = (np.abs(outline[others] - outline[own]) <= allowed[:, None]).all(axis=(1, 2))
            for other, within in zip(others[alike], allowed[alike], strict=True):
                if np.allclose(actions[other], actions[own], rtol=0, atol=within):
                    yield places[own], places[other]


def _ranks(names: Iterable[str], seed: str) -> dict[str, float]:
    """A number in [0, 1) for each group, which depends on the seed and the name alone."""
    return {name: hash64(f"{seed} {name}") / 2**64 for name in names}


def _test_groups(
    groups: Groups, ranks: Mapping[str, float], params: SplitParams, shares: Mapping[Side, float]
) -> set[str]:
    """The groups that are test whatever their rank; empty where the ranks decide.

    With folds, the groups of each source are dealt to the folds in the order of their ranks. Of
    two groups, where both val and test are asked for, the one of lower rank is test.
    """
    if params.folds is None:
        return {min(groups, key=ranks.__getitem__)} if len(groups) == len(shares) == 2 else set()
    if params.folds > len(groups):
        raise ConfigError(
            f"train_head.split.folds is {params.folds}, but the store has {len(groups)} group(s) "
            "of episodes, of which each is test in one fold. Set fewer folds, or folds null."
        )
    sources = {name: sorted({e.source for e in group}) for name, group in groups.items()}
    dealt = sorted(groups, key=lambda name: (sources[name], ranks[name]))
    return set(dealt[params.fold :: params.folds])


def _ranges(shares: Mapping[Side, float], drawn: float) -> Ranges:
    """The ranks of each side, train last.

    `shares` are shares of all groups; the ranks divide only the share `drawn` of the groups.
    """
    sides: tuple[Side, ...] = (*shares, "train")
    edges = np.minimum(np.cumsum([0.0, *shares.values()]) / drawn, 1.0).tolist()
    return dict(zip(sides, pairwise((*edges, 1.0)), strict=True))


class _Need(NamedTuple):
    """Each of these sides needs one of these groups."""

    of: str
    groups: frozenset[str]
    sides: tuple[Side, ...]
    weight: int
    """How much an empty side counts."""

    def empty_sides(self, side_of: Mapping[str, Side]) -> set[Side]:
        """The sides without any of the groups."""
        return set(self.sides) - {side_of[name] for name in self.groups}


def _needs(groups: Groups, drawn: Collection[str], sides: tuple[Side, ...]) -> list[_Need]:
    """The need of each source, by name, then the need of the store, which outweighs all others.

    A source of three or more groups needs one on each side, if enough are left after folds, else
    one to train on; a source of two needs one to train on; a source of one needs nothing.
    """
    by_source: dict[str, set[str]] = {}
    for name, group in groups.items():
        for episode in group:
            by_source.setdefault(episode.source, set()).add(name)
    needs: list[_Need] = []
    for source, own in sorted(by_source.items()):
        here = frozenset(own.intersection(drawn))
        every_side = len(own) > 2 and len(here) >= len(sides)
        if here and len(own) > 1:
            needs.append(_Need(f"source {source!r}", here, sides if every_side else ("train",), 1))
    return [*needs, _Need("all sources", frozenset(drawn), sides, 3 * len(by_source))]


def _fill_empty_sides(
    side_of: dict[str, Side], ranks: Mapping[str, float], ranges: Ranges, needs: Sequence[_Need]
) -> list[str]:
    """Move a group to each empty side of a need, in place; returns notes on the moves.

    For each need in turn, the best move leaves the fewest empty sides in this need and those before
    it; among equals, the group whose rank is nearest to the side's range moves. No group moves if
    every move would empty as much as it fills.
    """
    notes: list[str] = []
    for number, need in enumerate(needs, 1):
        for side in sorted(need.empty_sides(side_of)):
            low, high = ranges[side]
            change, _, name = min(
                (_change(side_of, n, side, needs[:number]), max(low - ranks[n], ranks[n] - high), n)
                for n in need.groups
            )
            if change < 0:
                side_of[name] = side
                notes.append(f"{side} had nothing of {need.of}, {name} was moved there")
    more = [f"and {len(notes) - _SHOWN} more"] if len(notes) > _SHOWN else []
    return [*notes[:_SHOWN], *more]


def _change(side_of: Mapping[str, Side], name: str, side: Side, needs: Iterable[_Need]) -> int:
    """The weight of the sides that a move of this group empties, less that of those it fills."""
    moved: dict[str, Side] = {**side_of, name: side}
    return sum(
        need.weight * (len(need.empty_sides(moved)) - len(need.empty_sides(side_of)))
        for need in needs
    )


def _cut_by_time(
    store: FeatureStore, episodes: Sequence[Episode], shares: Mapping[Side, float], horizon: int
) -> tuple[dict[Side, NDArray[np.int64]], list[str]]:
    """The sides of a single group, and notes: test is its end, val is before it, then train.

    All episodes are cut at the same instants, because they are one recording in several formats. A
    side begins at the earliest instant at which the last `share` of an episode's ticks begins.
    """
    if not shares:
        return {"train": ticks_of(episodes)}, []
    named = f"a single group ({', '.join(sorted(map(episode_name, episodes)))})"
    clocks = [_elapsed(store, episode) for episode in episodes]
    steps = np.concatenate([np.diff(clock) for clock in clocks])
    usual_step = float(np.median(steps)) if len(steps) else 0.0
    stops = [len(clock) for clock in clocks]
    sides: dict[Side, NDArray[np.int64]] = {}
    notes: list[str] = []
    for side, share in shares.items():
        counts = [round(share * len(clock)) for clock in clocks]
        if not any(counts):
            notes.append(f"{named}, too short to hold ticks out as {side}")
            continue
        begins = [
            clock[stop - count]
            for clock, stop, count in zip(clocks, stops, counts, strict=True)
            if 0 < count <= stop
        ]
        cut = min(begins, default=-np.inf)
        firsts = [int(np.searchsorted(clock, cut - _SLACK_S)) for clock in clocks]
        sides[side] = ticks_of(episodes, list(zip(firsts, stops, strict=True)))
        before = [_ticks_before(clock, cut, horizon, usual_step) for clock in clocks]
        stops = np.minimum(stops, before).tolist()
        notes.append(f"{named}: {share:.0%} of its ticks, cut from its end, are {side}")
    sides["train"] = ticks_of(episodes, [(0, stop) for stop in stops])
    if not len(sides["train"]):
        raise ConfigError(
            f"{named} of {', '.join(str(len(clock)) for clock in clocks)} ticks, of which the last "
            f"are held out ({', '.join(f'{side} {share:.0%}' for side, share in shares.items())}): "
            f"expected an action chunk of train_head.horizon {horizon} ticks before each side, "
            "found none. Set a shorter train_head.horizon, train_head.split.val=0 or "
            "train_head.split.test=0, or add recordings to data.sources."
        )
    if sides.keys() != {"train"}:
        notes.append("that says less than a recording never seen")
    return sides, notes


def _elapsed(store: FeatureStore, episode: Episode) -> NDArray[np.float64]:
    """(tick,) seconds since the newest frame of the first VL row, else since the first tick.

    So formats whose clocks differ, or whose ticks begin at different times, share one clock.
    """
    time = store.array("tick/time")[episode.ticks.start : episode.ticks.stop]
    frames = store.array("vl/frame_time")[episode.vl_rows.start]
    taken = frames[np.isfinite(frames)]
    return time - (taken.max() if len(taken) else time[0])


def _ticks_before(clock: NDArray[np.float64], cut: float, horizon: int, usual_step: float) -> int:
    """How many leading ticks have chunks that end before the cut.

    The last action lasts the clock's median step, or `usual_step` where there is only one tick.
    """
    first = int(np.searchsorted(clock, cut - _SLACK_S))
    last_step = np.median(np.diff(clock)) if len(clock) > 1 else usual_step
    ends = np.append(clock[1:], clock[-1] + last_step)
    # Where ticks of two formats alternate, the action of the tick before the cut lasts beyond it.
    done = first - 1 if first and ends[first - 1] > cut + _SLACK_S else first
    # Chunks do not reach beyond the episode's end.
    return done if done == len(clock) else max(0, done - (horizon - 1))


def ticks_of(
    episodes: Sequence[Episode], parts: Sequence[tuple[int, int]] | None = None
) -> NDArray[np.int64]:
    """The ticks of these episodes, ascending; with `parts`, only [first, stop) of each."""
    parts = [(0, len(episode.ticks)) for episode in episodes] if parts is None else parts
    own = [
        np.array(e.ticks[slice(*part)], np.int64) for e, part in zip(episodes, parts, strict=True)
    ]
    return np.sort(np.concatenate([np.empty(0, np.int64), *own]))


def hash64(text: str) -> int:
    """A 64-bit hash, the same in every process."""
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "big")
