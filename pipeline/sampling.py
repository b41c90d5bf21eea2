"""Which ticks are trained on, which are held out, and which come next.

Everything here is a pure function of the store's contents and of (seed, step): nothing has to be
saved to resume, and resuming at any step gives the same stream.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ConfigError, StoreMismatch

if TYPE_CHECKING:
    from pipeline.store import Episode, FeatureStore

_TAIL = 0.2
"""What a single episode holds out of its ticks."""


@dataclass(frozen=True, eq=False)
class Split:
    """Store-global ticks, ascending: trained on, and held out with the "source/id" they are of."""

    train: NDArray[np.int64]
    held_out: NDArray[np.int64]
    held_out_episodes: tuple[str, ...]
    note: str | None
    """What the reader of a metric has to know about this split, or None."""


def split_by_episode(store: FeatureStore, val_fraction: float, horizon: int = 8) -> Split:
    """Whole episodes on either side, by a hash of "source/id" that other episodes never change.

    Episodes whose first VL keys are equal are one recording in two formats and share a side, by
    the hash of the first of their names. Of two recordings at least one is held out and at least
    one trained on. A single one holds out the last 20 % of its ticks, and the `horizon - 1` ticks
    before those belong to neither side, so that no trained chunk holds a held-out action.
    Raises `StoreMismatch` where the store has no tick.
    """
    recordings = _recordings(store)
    if not recordings:
        raise StoreMismatch(
            f"{store.path}: expected ticks to train on, found none. Look at data.sources and run "
            "stages.extract again."
        )
    if val_fraction <= 0:
        everything = [episode for episodes in recordings.values() for episode in episodes]
        return Split(_ticks(everything), _ticks([]), (), None)
    if len(recordings) == 1:
        return _split_tail(next(iter(recordings.values())), horizon)
    ranks = {name: _unit_hash(name) for name in recordings}
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
        parts = [self._range(name, first[name], last[name]) for name in self._ticks]
        return np.concatenate(parts)

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
class _Leaf:
    name: str
    mass: Fraction

    def drawn(self, draws: int) -> dict[str, int]:
        return {self.name: draws}


@dataclass(frozen=True)
class _Fork:
    """Sends round(draws · share) to the left and the rest to the right, in exact arithmetic.

    Both counts grow by 0 or 1 a draw, so sources never take a draw back, which the method of
    largest remainders would (the Alabama paradox).
    """

    left: _Leaf | _Fork
    right: _Leaf | _Fork

    @property
    def mass(self) -> Fraction:
        return self.left.mass + self.right.mass

    def drawn(self, draws: int) -> dict[str, int]:
        left = (2 * draws * self.left.mass + self.mass) // (2 * self.mass)
        return self.left.drawn(left) | self.right.drawn(draws - left)


def _mixture(masses: Mapping[str, Fraction]) -> _Leaf | _Fork:
    """A Huffman tree over the sources: shallow, so that rounding adds up to little."""
    nodes: list[_Leaf | _Fork] = [_Leaf(name, masses[name]) for name in sorted(masses)]
    while len(nodes) > 1:
        nodes.sort(key=lambda node: node.mass)
        nodes = [_Fork(nodes[0], nodes[1]), *nodes[2:]]
    return nodes[0]


def _recordings(store: FeatureStore) -> dict[str, list[Episode]]:
    """Episodes that have ticks, by the first name among those with the same first VL key."""
    keys = store.array("vl/key")
    by_key: dict[bytes | str, list[Episode]] = {}
    for episode in store.episodes:
        if len(episode.ticks):
            rows = episode.vl_rows
            key = keys[rows.start].tobytes() if len(rows) else _name(episode)
            by_key.setdefault(key, []).append(episode)
    return {min(_names(episodes)): episodes for episodes in by_key.values()}


def _split_tail(episodes: list[Episode], horizon: int) -> Split:
    train, held_out = [], []
    for episode in episodes:
        ticks = _ticks([episode])
        boundary = len(ticks) - round(_TAIL * len(ticks))
        # At least one tick is trained on, however short the episode.
        train.append(ticks[: max(1, boundary - (horizon - 1))])
        held_out.append(ticks[boundary:])
    if not any(map(len, held_out)):
        note = f"a single recording ({', '.join(_names(episodes))}), too short to hold ticks out"
        return Split(np.concatenate(train), _ticks([]), (), note)
    note = (
        f"a single recording ({', '.join(_names(episodes))}): its last {_TAIL:.0%} of ticks are "
        "held out, which says less than a recording never seen"
    )
    return Split(np.concatenate(train), np.concatenate(held_out), _names(episodes), note)


def _ticks(episodes: list[Episode]) -> NDArray[np.int64]:
    ranges = [np.arange(e.ticks.start, e.ticks.stop, dtype=np.int64) for e in episodes]
    return np.sort(np.concatenate(ranges)) if ranges else np.empty(0, np.int64)


def _name(episode: Episode) -> str:
    return f"{episode.source}/{episode.id}"


def _names(episodes: list[Episode]) -> tuple[str, ...]:
    return tuple(sorted(_name(episode) for episode in episodes))


def _hash(text: str) -> int:
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "big")


def _unit_hash(text: str) -> float:
    return _hash(text) / 2**64
