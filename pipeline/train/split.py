"""Which ticks are trained on, which choose the checkpoint and which are reported.

And the sides of a checkpoint found again in a store.
"""

import hashlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.commands import command
from pipeline.base.config import SplitParams
from pipeline.base.differences import describe, differences
from pipeline.base.errors import CheckpointMismatch, ConfigError, StoreMismatch
from pipeline.base.tuned_on import SIDES, EpisodePart, Side
from pipeline.policy.checkpoint import SOURCE_KEYS, PolicyCheckpoint
from pipeline.store import Episode, FeatureStore, episode_name
from pipeline.train.groups import episodes_by_group

_SHOWN = 5
"""Groups that a note lists as moved."""

_SLACK_S = 1e-6
"""Two times that differ by less are one: seconds since 1970 in float64 are this coarse."""

Groups = Mapping[str, Sequence[Episode]]
Bounds = Mapping[Side, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Split:
    """Store-global ticks, ascending: trained on, choosing the checkpoint, and reported."""

    train: NDArray[np.int64]
    val: NDArray[np.int64]
    test: NDArray[np.int64]
    groups: Mapping[str, str]
    """"source/id" of each episode that has ticks -> its group."""
    note: str | None
    """What the reader of a metric has to know about this split, or None."""


def split_by_episode(
    store: FeatureStore,
    params: SplitParams,
    horizon: int = 8,
    keys: NDArray[np.uint8] | None = None,
) -> Split:
    """Whole groups of episodes on each side, by a hash of `params.seed` and the group's name.

    So an added episode moves none but those of its own group, save where a side would be empty: a
    source of three or more groups has one on each side that is asked for, one of two has one to
    train on, and all sources together have one on each side. `folds` deals the groups of each
    source in the order of their hashes, so that each is in test in one fold; `val` is drawn from
    the others. `train` leaves out all groups to train on but so many, the first by their hashes,
    which may leave a source with none.

    Of two groups one is test, and val is cut from the tail of the other. A single one is cut by
    time into all three, at one instant for all of its episodes: those are then one recording in
    several formats. Ticks whose chunk of `horizon` actions reaches into the next side belong to
    none.

    Raises `ConfigError` where that leaves nothing to train on, or there are fewer groups than
    folds, and `StoreMismatch` where the store has no tick. `keys` (vl_row, 16) stand in for the VL
    keys of a store that has none.
    """
    groups = episodes_by_group(store, params.groups, keys)
    if not groups:
        raise StoreMismatch(
            f"{store.path}: expected ticks to train on, found none. Look at data.sources and run "
            "stages.extract again."
        )
    shares: dict[Side, float] = {"test": params.test, "val": params.val}
    asked: dict[Side, float] = {side: share for side, share in shares.items() if share > 0}
    ranks = _ranks(groups, f"{params.seed}")
    test = _fold(groups, ranks, params)
    if not test and len(groups) == len(asked) == 2:
        test = {min(groups, key=lambda name: ranks[name])}
    if test:
        asked.pop("test", None)
    rest = {name: group for name, group in groups.items() if name not in test}
    if len(rest) == 1:
        sides, notes = _cut_by_time(store, next(iter(rest.values())), asked, horizon)
        notes = [f"of {len(groups)} groups {len(test)} is test", *notes] if test else notes
    else:
        ranks = ranks if params.folds is None else _ranks(rest, f"{params.seed}.{params.fold}")
        bounds = _bounds(asked, of=len(rest) / len(groups))
        side_of: dict[str, Side] = {
            name: next(side for side, (_, high) in bounds.items() if ranks[name] < high)
            for name in rest
        }
        notes = _repair(side_of, ranks, bounds, _quotas(groups, rest.keys(), tuple(bounds)))
        trained = sorted((n for n in rest if side_of[n] == "train"), key=lambda n: ranks[n])
        for name in trained[params.train :] if params.train is not None else ():
            del side_of[name]
        sides = {
            side: _ticks([e for name in rest if side_of.get(name) == side for e in rest[name]])
            for side in bounds
        }
    if test:
        sides["test"] = _ticks([e for name in test for e in groups[name]])
    return Split(
        *(sides.get(side, _ticks([])) for side in SIDES),
        groups={episode_name(e): name for name, group in groups.items() for e in group},
        note="; ".join(notes) or None,
    )


def _ranks(names: Iterable[str], seed: str) -> dict[str, float]:
    return {name: hash64(f"{seed} {name}") / 2**64 for name in names}


def _fold(groups: Groups, ranks: Mapping[str, float], params: SplitParams) -> set[str]:
    """The groups that are test in this fold: those of each source are dealt in turn."""
    if params.folds is None:
        return set()
    if params.folds > len(groups):
        raise ConfigError(
            f"train_head.split.folds is {params.folds}, but the store has {len(groups)} group(s) "
            "of episodes, of which each is test in one fold. Set fewer folds, or folds null."
        )
    sources = {name: sorted({e.source for e in group}) for name, group in groups.items()}
    dealt = sorted(groups, key=lambda name: (sources[name], ranks[name]))
    return set(dealt[params.fold :: params.folds])


def _bounds(shares: Mapping[Side, float], of: float) -> Bounds:
    """Between which ranks a group is on which side, shares being of `of` times all groups."""
    sides: tuple[Side, ...] = (*shares, "train")
    edges = np.minimum(np.cumsum([0.0, *shares.values()]) / of, 1.0).tolist()
    return dict(zip(sides, pairwise((*edges, 1.0)), strict=True))


@dataclass(frozen=True)
class _Quota:
    """Sides on each of which there has to be one of these groups."""

    of: str
    groups: frozenset[str]
    sides: tuple[Side, ...]
    weight: int
    """Of a side that is missing, where not all quotas can be met."""

    def missing(self, side_of: Mapping[str, Side]) -> set[Side]:
        """The sides that have none of these groups."""
        return set(self.sides) - {side_of[name] for name in self.groups}


def _quotas(groups: Groups, drawn: Collection[str], sides: tuple[Side, ...]) -> Iterator[_Quota]:
    """What of the groups drawn has to be on which side: of each source, then of all together."""
    sources = sorted({episode.source for episode in chain(*groups.values())})
    for source in sources:
        own = {name for name, group in groups.items() if any(e.source == source for e in group)}
        rest = frozenset(own.intersection(drawn))
        if len(own) > 2 and len(rest) >= len(sides):
            yield _Quota(f"source {source!r}", rest, sides, 1)
        elif len(own) > 1 and rest:
            yield _Quota(f"source {source!r}", rest, ("train",), 1)
    yield _Quota("all sources", frozenset(drawn), sides, 3 * len(sources))


def _repair(
    side_of: dict[str, Side], ranks: Mapping[str, float], bounds: Bounds, quotas: Iterable[_Quota]
) -> list[str]:
    """Move a group to each side that has none of a quota; returns what was moved.

    The one that leaves the least missing to this quota and those before it, of these the one whose
    rank is nearest; none where no move leaves less.
    """
    notes: list[str] = []
    before: list[_Quota] = []
    for quota in quotas:
        before.append(quota)
        for side in sorted(quota.missing(side_of)):
            low, high = bounds[side]
            change, _, name = min(
                (_change(side_of, n, side, before), max(low - ranks[n], ranks[n] - high), n)
                for n in quota.groups
            )
            if change < 0:
                side_of[name] = side
                notes.append(f"{side} had nothing of {quota.of}, {name} was moved there")
    more = [f"and {len(notes) - _SHOWN} more"] if len(notes) > _SHOWN else []
    return [*notes[:_SHOWN], *more]


def _change(side_of: Mapping[str, Side], name: str, side: Side, quotas: Iterable[_Quota]) -> int:
    """The weight of what the quotas miss with this group on that side, less what they miss now."""
    moved: dict[str, Side] = {**side_of, name: side}
    return sum(
        q.weight * (len(q.missing(moved)) - len(q.missing(side_of)))
        for q in quotas
        if name in q.groups
    )


def _cut_by_time(
    store: FeatureStore, episodes: Sequence[Episode], shares: Mapping[Side, float], horizon: int
) -> tuple[dict[Side, NDArray[np.int64]], list[str]]:
    """The sides of a single group, from its end: `shares` of its ticks, and what is before them.

    A side begins at the earliest instant at which its share of an episode's ticks begins.
    """
    if not shares:
        return {"train": _ticks(episodes)}, []
    named = f"a single group ({', '.join(sorted(map(episode_name, episodes)))})"
    clocks = [_elapsed(store, episode) for episode in episodes]
    steps = np.concatenate([np.diff(clock) for clock in clocks])
    usual = float(np.median(steps)) if len(steps) else 0.0
    stops = [len(clock) for clock in clocks]
    sides: dict[Side, NDArray[np.int64]] = {}
    notes: list[str] = []
    for side, share in shares.items():
        counts = [round(share * len(clock)) for clock in clocks]
        if not any(counts):
            notes.append(f"{named}, too short to hold ticks out as {side}")
            continue
        starts = [
            clock[stop - n]
            for clock, stop, n in zip(clocks, stops, counts, strict=True)
            if 0 < n <= stop
        ]
        cut = min(starts, default=-np.inf)
        edges = [_around(clock, cut, horizon, usual) for clock in clocks]
        sides[side] = _ticks(
            episodes, [(first, stop) for (_, first), stop in zip(edges, stops, strict=True)]
        )
        stops = [min(stop, done) for (done, _), stop in zip(edges, stops, strict=True)]
        notes.append(f"{named}: {share:.0%} of its ticks, cut from its end, are {side}")
    sides["train"] = _ticks(episodes, [(0, stop) for stop in stops])
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
    """The times (tick,) in s since the newest frame of the first VL row: one for all formats.

    Their clocks may differ and their ticks begin apart. Without a view, since the first tick.
    """
    time = store.array("tick/time")[episode.ticks.start : episode.ticks.stop]
    frames = store.array("vl/frame_time")[episode.vl_rows.start]
    taken = frames[np.isfinite(frames)]
    return time - (taken.max() if len(taken) else time[0])


def _around(
    clock: NDArray[np.float64], cut: float, horizon: int, usual_step: float
) -> tuple[int, int]:
    """How many leading ticks have chunks that end before the cut, and the first tick at it.

    A clock's last action lasts its median step, and `usual_step` where it has but one tick.
    """
    first = int(np.searchsorted(clock, cut - _SLACK_S))
    last_step = np.median(np.diff(clock)) if len(clock) > 1 else usual_step
    ends = np.append(clock[1:], clock[-1] + last_step)
    # Where ticks of two formats alternate, the action of the tick before the cut lasts beyond it.
    done = first - 1 if first and ends[first - 1] > cut + _SLACK_S else first
    # Chunks do not reach beyond the episode's end.
    return (done if done == len(clock) else max(0, done - (horizon - 1))), first


def _ticks(
    episodes: Sequence[Episode], parts: Sequence[tuple[int, int]] | None = None
) -> NDArray[np.int64]:
    """The ticks of these episodes, or [first, stop) of each, counted in the episode; ascending."""
    parts = [(0, len(episode.ticks)) for episode in episodes] if parts is None else parts
    own = [
        np.array(e.ticks[slice(*part)], np.int64) for e, part in zip(episodes, parts, strict=True)
    ]
    return np.sort(np.concatenate([np.empty(0, np.int64), *own]))


def hash64(text: str) -> int:
    """A 64-bit hash, the same in every process."""
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "big")


def source_of(store: FeatureStore) -> dict[str, Any]:
    """What a checkpoint remembers of its store, and what another store must agree with."""
    return {key: getattr(store, "spec" if key == "feature_spec" else key) for key in SOURCE_KEYS}


def list_differences(expected: Any, actual: Any) -> str:
    """Where two documents differ, on an indented line each; empty where nowhere."""
    return "\n".join(f"  {line}" for line in describe(differences(expected, actual)))


def check_store(checkpoint: PolicyCheckpoint, store: FeatureStore) -> None:
    """Raise `CheckpointMismatch`, naming what differs, when the policy does not fit this store."""
    if differing := list_differences(checkpoint.source, source_of(store)):
        raise CheckpointMismatch(
            f"the checkpoint does not fit {store.path} (the checkpoint -> the store):\n"
            f"{differing}\nName the store it was trained from in evaluate.store, extract with the "
            f"params it was trained with, or train again: {command('train_head')}"
        )


def split_parts(store: FeatureStore, split: Split) -> dict[Side, dict[str, EpisodePart]]:
    """What a checkpoint says of each side: its episodes by "source/id".

    In a way that outlives episodes that are added before these.
    """
    return {side: _parts(store, getattr(split, side), split.groups) for side in SIDES}


def _parts(
    store: FeatureStore, ticks: NDArray[np.int64], groups: Mapping[str, str]
) -> dict[str, EpisodePart]:
    edges = np.searchsorted(ticks, store.array("episode/tick_start"))
    parts = {}
    for index in np.flatnonzero(np.diff(edges)):
        episode, inside = store.episodes[index], ticks[edges[index] : edges[index + 1]]
        name, start = episode_name(episode), episode.ticks.start
        first, stop = int(inside[0]) - start, int(inside[-1]) + 1 - start
        assert len(inside) == stop - first, "ticks of an episode on one side lie side by side"
        parts[name] = EpisodePart(ticks=(first, stop), content=episode.content, group=groups[name])
    return parts


def find_ticks(
    store: FeatureStore, checkpoint: PolicyCheckpoint, side: Side
) -> tuple[NDArray[np.int64], PolicyCheckpoint]:
    """The store's ticks of a side, ascending, and the checkpoint with the store's names of them.

    An episode whose source or folder was renamed since is told by the digest of its files. Raises
    `CheckpointMismatch` where the side has no episode, or where the store lacks one, has a shorter
    one of that name, or one made from other files.
    """
    parts = checkpoint.split[side]
    if not parts:
        raise CheckpointMismatch(
            f"the checkpoint lists no {side} episode, so there is nothing to look at: it was "
            f"trained with train_head.split.{side} 0, or on too short a recording. Train again "
            f"with train_head.split.{side} above 0."
        )
    by_name = {episode_name(episode): episode for episode in store.episodes}
    renamed: dict[str, list[Episode]] = {}
    for name, episode in by_name.items():
        if name not in parts or parts[name].content != episode.content:
            renamed.setdefault(episode.content, []).append(episode)
    there: list[tuple[Episode, EpisodePart]] = []
    wrong: list[str] = []
    for name, part in parts.items():
        episode = by_name.get(name)
        same = episode is not None and episode.content == part.content
        if not same and (elsewhere := renamed.get(part.content)):
            episode = elsewhere.pop()
        if episode is None or episode.content != part.content or len(episode.ticks) < part.ticks[1]:
            wrong.append(name)
        else:
            there.append((episode, part))
    if wrong:
        raise CheckpointMismatch(
            f"{store.path}: of the {len(parts)} {side} episodes of the checkpoint, {len(wrong)} "
            f"are missing, shorter, or other recordings than they were: {', '.join(wrong[:5])}"
            f"{' …' if len(wrong) > 5 else ''}. Name the store it was trained from in "
            "evaluate.store, or train again."
        )
    named = {episode_name(episode): part for episode, part in there}
    return (
        _ticks([episode for episode, _ in there], [part.ticks for _, part in there]),
        replace(checkpoint, split={**checkpoint.split, side: named}),
    )


def groups_of(
    store: FeatureStore, checkpoint: PolicyCheckpoint, ticks: NDArray[np.int64]
) -> NDArray[np.str_]:
    """(tick,) the group of the episode of each of these ticks, which `find_ticks` gave."""
    parts = chain.from_iterable(side.values() for side in checkpoint.split.values())
    # By content: a renamed episode keeps its group, and episodes of equal content share one.
    group_of = {part.content: part.group for part in parts}
    indices, place = np.unique(store.episode_of(ticks), return_inverse=True)
    return np.array([group_of[store.episodes[index].content] for index in indices], str)[place]
