"""What every step of a run is made of: a function of (seed, step), cut into parts."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import ConfigError
from pipeline.store import FeatureStore
from pipeline.train.batches import BatchIndices
from pipeline.train.mixture import TickSampler, ticks_by_source
from pipeline.train.split import Split
from pipeline.train.world import World

_VARIANTS = (0, 1)
"""After (seed, step), tells the random numbers that pick variants from those of any part: numpy
takes (seed, step, part) for (seed, step, part, 0), so that a third number would not do."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Part(BatchIndices):
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

    def ticks(self, step: int) -> NDArray[np.int64]:
        """The ticks (batch_size,) of a step, over all parts and processes."""
        return self._sampler.batch(step)

    def step(self, step: int) -> list[Part]:
        """This process's parts of a step, counted from 0."""
        ticks, variants = self.ticks(step), self._draw_variants(step)
        counts = self._valid(ticks)
        cuts = np.array_split(np.arange(len(ticks)), self.parts)
        return [
            Part(
                ticks[cuts[p]],
                None if variants is None else variants[cuts[p]],
                share=float(counts[cuts[p]].sum() / counts.sum()),
                seed=_seed(self._params.seed, step, p),
            )
            for p in self.own
        ]

    def draws(self, steps: range) -> Iterator[Part]:
        """This process's parts of these steps, one after the other."""
        return (part for step in steps for part in self.step(step))

    def _draw_variants(self, step: int) -> NDArray[np.int64] | None:
        if self._variants == 1:
            return None
        rng = np.random.default_rng((self._params.seed, step, *_VARIANTS))
        return rng.integers(self._variants, size=self._params.batch_size)

    def _valid(self, ticks: NDArray[np.int64]) -> NDArray[np.int64]:
        """How many steps of each tick's chunk count in the loss: those before its episode's end."""
        if self._params.terminal_stop:
            return np.full(len(ticks), self._params.horizon)
        return np.minimum(self._params.horizon, self._ends[ticks] - ticks)


def _seed(*entropy: int) -> int:
    return int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0])
