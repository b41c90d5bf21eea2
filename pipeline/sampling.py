"""Which ticks are trained on, which are held out, and which come next.

Everything here is a pure function of the store's contents and of (seed, step): nothing has to be
saved to resume, and resuming at any step gives the same stream.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ConfigError, StoreMismatch

if TYPE_CHECKING:
    from pipeline.store import Episode, FeatureStore

_TAIL = 0.2
"""What a single recording holds out of its ticks."""

_SLACK_S = 1e-6
"""Two times that differ by less are one: seconds since 1970 in float64 are this coarse."""


@dataclass(frozen=True, eq=False)
class Split:
    """Store-global ticks, ascending: trained on, and held out with the "source/id" they are of."""

    train: NDArray[np.int64]
    held_out: NDArray[np.int64]
    held_out_episodes: tuple[str, ...]
    note: str | None
    """What the reader of a metric has to know about this split, or None."""


def split_by_episode(store: FeatureStore, val_fraction: float, horizon: int = 8) -> Split:
    """Whole episodes on either side, by a hash of "source/id".

    Episodes whose first VL keys are equal are one recording in several formats and share a side,
    by the hash of the first of their names. So an added episode moves none but other formats of
    itself, save where a side would be empty: of two recordings one is held out, one trained on.

    A single recording is cut at one instant for all of its formats: the earliest at which the last
    20 % of a format's ticks begin. Ticks from there on are held out; ticks before it whose chunk
    of `horizon` actions is not over by then belong to neither side. Raises `ConfigError` where that
    leaves nothing to train on, `StoreMismatch` where the store has no tick.
    """
    recordings = _recordings(store)
    if not recordings:
        raise StoreMismatch(
            f"{store.path}: expected ticks to train on, found none. Look at data.sources and run "
            "stages.extract again."
        )
    if val_fraction <= 0:
        return Split(_ticks(store.episodes), _ticks([]), (), None)
    if len(recordings) == 1:
        return _split_tail(store, next(iter(recordings.values())), horizon)
    ranks = {name: _hash(name) / 2**64 for name in recordings}
    chosen = {name for name, rank in ranks.items() if rank < val_fraction}
    note = None
    if not chosen:
        chosen = {min(ranks, key=lambda name: ranks[name])}
        note = f"val_fraction {val_fraction} of {len(ranks)} recordings is none; one is held out"
    elif len(chosen) == len(ranks):
        chosen.remove(max(ranks, key=lambda name: ranks[name]))
        note = f"val_fraction {val_fraction} of {len(ranks)} recordings is all; one is trained on"
    train = [e for name, episodes in recordings.items() if name not in chosen for e in episodes]
    held_out = [e for name in chosen for e in recordings[name]]
    return Split(_ticks(train), _ticks(held_out), _names(held_out), note)


def ticks_by_source(store: FeatureStore, ticks: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
    """The ticks of each of the store's sources, in the order given; empty where it has none."""
    starts = np.array([episode.ticks.start for episode in store.episodes], np.int64)
    names = np.array([episode.source for episode in store.episodes])
    # Of episodes that start at the same tick, only the last can hold it: the others are empty.
    sources = names[np.searchsorted(starts, ticks, side="right") - 1]
    return {name: ticks[sources == name] for name in store.sources}


class TickSampler:
    """An endless, resumable mixture of shuffled ticks.

    A source's share of the draws is its weight times its number of ticks, over the sum of these:
    weight 1 for all is uniform over ticks, weight 3 shows a tick of that source three times as
    often; it is kept to one draw at any time for up to three sources (1.5 for eight). Within a
    source every tick comes once an epoch. Weights that are not named are 1; a source of weight 0
    or without ticks is left out. Raises `ConfigError` on unknown names or where nothing is left.
    """

    def __init__(
        self,
        ticks_by_source: Mapping[str, NDArray[np.int64]],
        weights: Mapping[str, float],
        batch_size: int,
        seed: int,
    ) -> None:
        unknown = sorted(set(weights) - set(ticks_by_source))
        if unknown:
            raise ConfigError(
                f"train_head.mixture names {', '.join(unknown)}, but the store has only "
                f"{', '.join(sorted(ticks_by_source)) or 'no source'}"
            )
        size = {
            name: Fraction(weights.get(name, 1.0)) * len(ticks)
            for name, ticks in ticks_by_source.items()
        }
        size = {name: mass for name, mass in size.items() if mass > 0}
        if not size:
            raise ConfigError(
                "train_head.mixture leaves nothing to train on: expected a source with ticks and "
                f"a weight above 0, found { {n: len(t) for n, t in ticks_by_source.items()} } "
                f"ticks under weights {dict(weights)}"
            )
        self.batch_size, self.seed = batch_size, seed
        self.shares = {name: float(mass / sum(size.values())) for name, mass in size.items()}
        self._mixture = _mixture(size)
        self._ticks = {name: ticks_by_source[name] for name in size}
        self._orders: dict[tuple[str, int], NDArray[np.int64]] = {}

    def batch(self, step: int) -> NDArray[np.int64]:
        """The ticks (batch_size,) of this step, source by source: a function of (seed, step)."""
        first = self.drawn(step * self.batch_size)
        last = self.drawn((step + 1) * self.batch_size)
        return np.concatenate([self._range(name, first[name], last[name]) for name in self._ticks])

    def drawn(self, draws: int) -> dict[str, int]:
        """How many of the first `draws` ticks each source gave."""
        return self._mixture.drawn(draws)

    def _range(self, name: str, start: int, stop: int) -> NDArray[np.int64]:
        """The draws [start, stop) of one source, across epochs."""
        ticks = self._ticks[name]
        parts: list[NDArray[np.int64]] = []
        while start < stop:
            epoch, offset = divmod(start, len(ticks))
            taken = min(len(ticks) - offset, stop - start)
            parts.append(ticks[self._order(name, epoch)[offset : offset + taken]])
            start += taken
        return np.concatenate(parts) if parts else _ticks([])

    def _order(self, name: str, epoch: int) -> NDArray[np.int64]:
        key = (name, epoch)
        if key not in self._orders:
            for old in [k for k in self._orders if k[0] == name]:
                del self._orders[old]
            entropy = (self.seed, _hash(name), epoch)
            self._orders[key] = np.random.default_rng(entropy).permutation(len(self._ticks[name]))
        return self._orders[key]


@dataclass(frozen=True)
class _Node:
    """A source, or a fork that divides draws between two nodes; mass is weight times ticks."""

    mass: Fraction
    source: str = ""
    fork: tuple[_Node, _Node] | None = None

    def drawn(self, draws: int) -> dict[str, int]:
        """How many of the first `draws` that come here each source from here on gets.

        The left gets round(draws · share), exactly, the right the rest: of one more draw either
        gets 0 or 1 more, and so does every source. Rounding source by source and handing out the
        remainder would take draws back (the Alabama paradox).
        """
        if self.fork is None:
            return {self.source: draws}
        left, right = self.fork
        to_left = (2 * draws * left.mass + self.mass) // (2 * self.mass)
        return left.drawn(to_left) | right.drawn(draws - to_left)


def _mixture(masses: Mapping[str, Fraction]) -> _Node:
    """Forks to all sources, the two lightest nodes joined until one is left: a Huffman tree.

    Each fork rounds by half a draw. Split off one after the other, eight sources would add that up
    to more than 1.5 draws; here heavy sources are a fork or two away.
    """
    nodes = [_Node(masses[name], name) for name in sorted(masses)]
    while len(nodes) > 1:
        left, right, *others = sorted(nodes, key=lambda node: node.mass)
        nodes = [_Node(left.mass + right.mass, fork=(left, right)), *others]
    return nodes[0]


def _recordings(store: FeatureStore) -> dict[str, list[Episode]]:
    """Episodes that have ticks, by the first name among those with the same first VL key."""
    keys = store.array("vl/key")
    by_key: dict[bytes, list[Episode]] = {}
    for episode in store.episodes:
        if len(episode.ticks):
            by_key.setdefault(keys[episode.vl_rows.start].tobytes(), []).append(episode)
    return {min(_names(episodes)): episodes for episodes in by_key.values()}


def _split_tail(store: FeatureStore, episodes: list[Episode], horizon: int) -> Split:
    named = f"a single recording ({', '.join(_names(episodes))})"
    clocks = [_elapsed(store, episode) for episode in episodes]
    begins = [clock[-n] for clock in clocks if (n := round(_TAIL * len(clock)))]
    if not begins:
        return Split(_ticks(episodes), _ticks([]), (), f"{named}, too short to hold ticks out")
    train, held_out = [], []
    for episode, clock in zip(episodes, clocks, strict=True):
        trained, first = _sides(clock, min(begins), horizon)
        train.append(_ticks([episode])[:trained])
        held_out.append(_ticks([episode])[first:])
    if not any(map(len, train)):
        raise ConfigError(
            f"{named} of {', '.join(str(len(clock)) for clock in clocks)} ticks, its last "
            f"{_TAIL:.0%} held out: expected an action chunk of train_head.horizon {horizon} ticks "
            "before those, found none. Set a shorter train_head.horizon or "
            "train_head.val_fraction=0, or add recordings to data.sources."
        )
    note = (
        f"{named}: its last {_TAIL:.0%} of ticks are held out, "
        "which says less than a recording never seen"
    )
    names = _names([e for e, ticks in zip(episodes, held_out, strict=True) if len(ticks)])
    return Split(np.sort(np.concatenate(train)), np.sort(np.concatenate(held_out)), names, note)


def _elapsed(store: FeatureStore, episode: Episode) -> NDArray[np.float64]:
    """The times (tick,) in s since the newest frame of the first VL row: one for all formats.

    Their clocks may differ and their ticks begin apart. Without a view, since the first tick.
    """
    time = store.array("tick/time")[episode.ticks.start : episode.ticks.stop]
    frames = store.array("vl/frame_time")[episode.vl_rows.start]
    taken = frames[np.isfinite(frames)]
    return time - (taken.max() if len(taken) else time[0])


def _sides(clock: NDArray[np.float64], cut: float, horizon: int) -> tuple[int, int]:
    """How many leading ticks have chunks that end before the cut, and the first tick at it."""
    first = int(np.searchsorted(clock, cut - _SLACK_S))
    last_step = np.median(np.diff(clock)) if len(clock) > 1 else 0.0
    ends = np.append(clock[1:], clock[-1] + last_step)
    # Where ticks of two formats alternate, the action of the tick before the cut lasts beyond it.
    done = first - 1 if first and ends[first - 1] > cut + _SLACK_S else first
    # Chunks do not reach beyond the episode's end.
    return (done if done == len(clock) else max(0, done - (horizon - 1))), first


def _ticks(episodes: Sequence[Episode]) -> NDArray[np.int64]:
    ranges = [np.arange(e.ticks.start, e.ticks.stop, dtype=np.int64) for e in episodes]
    return np.sort(np.concatenate(ranges)) if ranges else np.empty(0, np.int64)


def _names(episodes: Sequence[Episode]) -> tuple[str, ...]:
    return tuple(sorted(f"{episode.source}/{episode.id}" for episode in episodes))


def _hash(text: str) -> int:
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "big")
