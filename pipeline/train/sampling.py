"""What every step of a run is made of: a weighted mixture of shuffled sources, cut into parts.

All of it is a function of (seed, step).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import ConfigError
from pipeline.store import FeatureStore
from pipeline.train.batches import BatchIndices, Lags, Ticks
from pipeline.train.split import Split, hash64
from pipeline.train.world import World


def ticks_by_source(store: FeatureStore, ticks: Ticks) -> dict[str, Ticks]:
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
        ticks_by_source: Mapping[str, Ticks],
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
        self.count_drawn = _mixture(size).count_drawn
        """How many of the first so many draws each source gave."""
        self.shares = {name: float(mass / sum(size.values())) for name, mass in size.items()}
        self._ticks = {name: ticks_by_source[name] for name in size}
        self._order = lru_cache(2 * len(size))(self._shuffle)

    def batch(self, step: int) -> Ticks:
        """The ticks (batch_size,) of this step, source by source: a function of (seed, step)."""
        first, last = (self.count_drawn(n * self.batch_size) for n in (step, step + 1))
        return np.concatenate([self._range(name, first[name], last[name]) for name in self._ticks])

    def _range(self, name: str, start: int, stop: int) -> Ticks:
        """The draws [start, stop) of one source, across epochs."""
        ticks = self._ticks[name]
        parts: list[Ticks] = []
        while start < stop:
            epoch, offset = divmod(start, len(ticks))
            taken = min(len(ticks) - offset, stop - start)
            parts.append(ticks[self._order(name, epoch)[offset : offset + taken]])
            start += taken
        return np.concatenate(parts) if parts else np.zeros(0, np.int64)

    def _shuffle(self, name: str, epoch: int) -> Ticks:
        """The order of a source's ticks in one epoch."""
        rng = np.random.default_rng((self.seed, hash64(name), epoch))
        return rng.permutation(len(self._ticks[name]))


@dataclass(frozen=True)
class _Node:
    """A source, or a fork that divides draws between two nodes; mass is weight times ticks."""

    mass: Fraction
    source: str = ""
    fork: tuple["_Node", "_Node"] | None = None

    def count_drawn(self, draws: int) -> dict[str, int]:
        """How many of the first `draws` that come here each source from here on gets.

        The left gets round(draws · share), exactly, the right the rest: of one more draw either
        gets 0 or 1 more, and so does every source. Rounding source by source and handing out the
        remainder would take draws back (the Alabama paradox).
        """
        if self.fork is None:
            return {self.source: draws}
        left, right = self.fork
        to_left = (2 * draws * left.mass + self.mass) // (2 * self.mass)
        return left.count_drawn(to_left) | right.count_drawn(draws - to_left)


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


_VARIANTS, _LAGS = (0, 1), (0, 2)
"""After (seed, step), tell the random numbers that pick variants and lags from those of any part:
numpy takes (seed, step, part) for (seed, step, part, 0), so that a third number would not do."""


@dataclass(frozen=True, eq=False, kw_only=True)
class StepPart(BatchIndices):
    """A part of a step's batch, computed at once; a feed hands it back beside its batch."""

    share: float
    """Of the step's valid chunk steps: what the part's mean loss counts in the whole mean."""
    seed: int
    """Of its dropout and its sampled noise: a function of (seed, step, part)."""


class Plan:
    """The ticks of every step, in as many parts as processes times `grad_accumulation`.

    Parts p·a to p·a + a - 1 are those of process p, so that N processes do what one with N times
    the accumulation does. Everything follows from params and store: nothing is communicated and
    nothing has to be kept to go on from any step. `section` of the params is the one that errors
    name. Raises `ConfigError` where parts would be empty.
    """

    def __init__(
        self,
        store: FeatureStore,
        params: TrainHeadParams,
        split: Split,
        world: World,
        section: str = "train_head",
    ) -> None:
        self.parts = world.size * params.grad_accumulation
        if params.batch_size < self.parts:
            raise ConfigError(
                f"{section}.batch_size is {params.batch_size}: expected a tick at least for "
                f"each of the {self.parts} parts of a step ({world.size} process(es) x "
                f"grad_accumulation {params.grad_accumulation}). Raise it, or accumulate less."
            )
        first = world.rank * params.grad_accumulation
        self.own = range(first, first + params.grad_accumulation)
        """The parts of this process."""
        self._sampler = TickSampler(
            ticks_by_source(store, split.train), params.mixture, params.batch_size, params.seed
        )
        self._params, self._variants = params, store.variants
        starts = store.array("episode/tick_start")
        self._ends = np.repeat(starts[1:], np.diff(starts))

    def ticks(self, step: int) -> Ticks:
        """The ticks (batch_size,) of a step, over all parts and processes."""
        return self._sampler.batch(step)

    def step(self, step: int) -> list[StepPart]:
        """This process's parts of a step, counted from 0."""
        ticks, seed = self.ticks(step), self._params.seed
        variants: NDArray[np.int64] | None = None
        if self._variants > 1:
            rng = np.random.default_rng((seed, step, *_VARIANTS))
            variants = rng.integers(self._variants, size=len(ticks))
        late = np.random.default_rng((seed, step, *_LAGS))
        feature_lag = late.integers(self._params.feature_lag + 1, size=len(ticks))
        sensor_lag_s = late.uniform(0, self._params.sensor_lag_s, len(ticks))
        # Of each chunk, the steps before its episode's end count; of one that stands still, all.
        counts = np.full(len(ticks), self._params.horizon)
        if not self._params.terminal_stop:
            counts = np.minimum(counts, self._ends[ticks] - ticks)
        cuts = np.array_split(np.arange(len(ticks)), self.parts)
        return [
            StepPart(
                ticks[cuts[p]],
                None if variants is None else variants[cuts[p]],
                Lags(feature_lag[cuts[p]], sensor_lag_s[cuts[p]]),
                share=float(counts[cuts[p]].sum() / counts.sum()),
                seed=int(np.random.SeedSequence((seed, step, p)).generate_state(1, np.uint64)[0]),
            )
            for p in self.own
        ]

    def parts_of(self, steps: range) -> Iterator[StepPart]:
        """This process's parts of these steps, one after the other."""
        return (part for step in steps for part in self.step(step))
