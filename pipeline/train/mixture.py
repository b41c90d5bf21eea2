"""Which tick comes next: a weighted mixture of shuffled sources."""

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import ConfigError
from pipeline.store import FeatureStore
from pipeline.train.split import hash64


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
        return np.concatenate(parts) if parts else np.zeros(0, np.int64)

    def _order(self, name: str, epoch: int) -> NDArray[np.int64]:
        key = (name, epoch)
        if key not in self._orders:
            for old in [k for k in self._orders if k[0] == name]:
                del self._orders[old]
            entropy = (self.seed, hash64(name), epoch)
            self._orders[key] = np.random.default_rng(entropy).permutation(len(self._ticks[name]))
        return self._orders[key]


@dataclass(frozen=True)
class _Node:
    """A source, or a fork that divides draws between two nodes; mass is weight times ticks."""

    mass: Fraction
    source: str = ""
    fork: tuple["_Node", "_Node"] | None = None

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
