"""What each step of a run learns from: a weighted mixture of shuffled sources, cut into parts.

Everything is a function of (seed, step), so a run can resume at any step without stored state.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from math import lcm
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import ConfigError
from pipeline.store import FeatureStore
from pipeline.train.batches import BatchIndices, Lags, Ticks
from pipeline.train.split import Split, hash64


def ticks_by_source(store: FeatureStore, ticks: Ticks) -> dict[str, Ticks]:
    """These ticks by source of the store, in their order; empty for a source without any."""
    starts = np.array([episode.ticks.start for episode in store.episodes], np.int64)
    names = np.array([episode.source for episode in store.episodes])
    # If several episodes start at the same tick, only the last holds it: the others are empty.
    sources = names[np.searchsorted(starts, ticks, side="right") - 1]
    return {name: ticks[sources == name] for name in store.sources}


_Tree = tuple[int, "str | tuple[_Tree, _Tree]"]
"""A mass, and the source or the two parts that have it."""


class TickSampler:
    """An endless, resumable mixture of shuffled ticks: each batch is a function of (seed, step).

    A source's share of the draws is its weight times its number of ticks, over the sum of these:
    weight 1 for all is uniform over ticks, weight 3 shows a tick of that source three times as
    often. After any number of draws, the count of each source is within 1 draw of its share with up
    to three sources, within 1.5 with eight. Within a source every tick comes once an epoch. Weights
    are 1 unless named; a source of weight 0 or without ticks is left out. Raises `ConfigError` on
    unknown names or if no source is left.
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
        exact = {name: Fraction(weights.get(name, 1.0)) for name in ticks_by_source}
        scale = lcm(*(weight.denominator for weight in exact.values()))
        masses = {name: int(exact[name] * scale) * len(t) for name, t in ticks_by_source.items()}
        masses = {name: mass for name, mass in masses.items() if mass > 0}
        if not masses:
            raise ConfigError(
                "train_head.mixture leaves nothing to train on: expected a source with ticks and "
                f"a weight above 0, found { {n: len(t) for n, t in ticks_by_source.items()} } "
                f"ticks under weights {dict(weights)}"
            )
        self.batch_size, self.seed = batch_size, seed
        self.shares = {name: mass / sum(masses.values()) for name, mass in masses.items()}
        self._tree = _fork(masses)
        self._ticks = {name: ticks_by_source[name] for name in masses}
        self._order = lru_cache(2 * len(masses))(self._shuffle)

    def batch(self, step: int) -> Ticks:
        """The ticks (batch_size,) of this step, source by source."""
        first, last = (self.count_drawn(n * self.batch_size) for n in (step, step + 1))
        return np.concatenate([self._range(name, first[name], last[name]) for name in self._ticks])

    def count_drawn(self, draws: int) -> dict[str, int]:
        """How many of the first `draws` draws each source gives.

        At each fork the left side takes its rounded share and the right side the rest, so one more
        draw adds 1 to exactly one source. Rounding each source alone could lower a count again.
        """
        return _deal(self._tree, draws)

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


def _fork(masses: Mapping[str, int]) -> _Tree:
    """The tree of the sources, as Huffman's: the two lightest parts are joined until one is left.

    So a heavy source is a fork or two below the root, and few roundings, of half a draw each, add
    up on the way to it.
    """
    trees: list[_Tree] = [(masses[name], name) for name in sorted(masses)]
    while len(trees) > 1:
        left, right, *rest = sorted(trees, key=itemgetter(0))
        trees = [(left[0] + right[0], (left, right)), *rest]
    return trees[0]


def _deal(tree: _Tree, draws: int) -> dict[str, int]:
    mass, below = tree
    if isinstance(below, str):
        return {below: draws}
    left, right = below
    share = (2 * draws * left[0] + mass) // (2 * mass)
    return _deal(left, share) | _deal(right, draws - share)


_VARIANTS, _LAGS = (0, 1), (0, 2)
"""Appended to (seed, step) in the seeds of variants and lags, so that these differ from the seed of
every part. One number would not do: numpy reads (seed, step, part) as (seed, step, part, 0)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class StepPart(BatchIndices):
    """A part of a step's batch, computed in one pass; a feed hands it back beside its batch."""

    share: float
    """The part's share of the step's valid chunk steps: the weight of its mean loss."""
    seed: int
    """The seed of the part's dropout and sampled noise: a function of (seed, step, part)."""


class Plan:
    """The ticks of every step, cut into `grad_accumulation` parts.

    `section` is the section of the params that errors name. Raises `ConfigError` where a part would
    be empty.
    """

    def __init__(
        self,
        store: FeatureStore,
        params: TrainHeadParams,
        split: Split,
        section: str = "train_head",
    ) -> None:
        if params.batch_size < params.grad_accumulation:
            raise ConfigError(
                f"{section}.batch_size is {params.batch_size}: expected a tick at least for each "
                f"of the {params.grad_accumulation} parts of {section}.grad_accumulation. Raise "
                "it, or accumulate less."
            )
        self._sampler = TickSampler(
            ticks_by_source(store, split.train), params.mixture, params.batch_size, params.seed
        )
        self._params, self._variants = params, store.variants
        starts = store.array("episode/tick_start")
        self._ends = np.repeat(starts[1:], np.diff(starts))

    def ticks(self, step: int) -> Ticks:
        """The ticks (batch_size,) of a step, over all parts."""
        return self._sampler.batch(step)

    def step(self, step: int) -> list[StepPart]:
        """The parts of a step, counted from 0."""
        ticks, seed = self.ticks(step), self._params.seed
        variants: NDArray[np.int64] | None = None
        if self._variants > 1:
            rng = np.random.default_rng((seed, step, *_VARIANTS))
            variants = rng.integers(self._variants, size=len(ticks))
        late = np.random.default_rng((seed, step, *_LAGS))
        feature_lag = late.integers(self._params.feature_lag + 1, size=len(ticks))
        sensor_lag_s = late.uniform(0, self._params.sensor_lag_s, len(ticks))
        # Only chunk steps before the episode's end count.
        counts = np.minimum(self._params.horizon, self._ends[ticks] - ticks)
        cuts = np.array_split(np.arange(len(ticks)), self._params.grad_accumulation)
        return [
            StepPart(
                ticks[cut],
                None if variants is None else variants[cut],
                Lags(feature_lag[cut], sensor_lag_s[cut]),
                share=float(counts[cut].sum() / counts.sum()),
                seed=int(np.random.SeedSequence((seed, step, p)).generate_state(1, np.uint64)[0]),
            )
            for p, cut in enumerate(cuts)
        ]

    def parts_of(self, steps: range) -> Iterator[StepPart]:
        """The parts of these steps, one after the other."""
        return (part for step in steps for part in self.step(step))
