"""A policy's actions at recorded ticks, beside the recorded actions."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Generator
from tqdm import tqdm

from pipeline.policy.policy import Trainable
from pipeline.store import Batch, FeatureStore
from pipeline.train.batches import (
    NO_LAGS,
    BatchIndices,
    Lags,
    Prefetch,
    Ticks,
    Windows,
    cut_batches,
)
from pipeline.train.statistics import check_finite

Actions = NDArray[np.float32]
FeedMaker = Callable[
    [Sequence[BatchIndices]], AbstractContextManager[Iterable[tuple[BatchIndices, Batch]]]
]
"""Makes the feed of a plan: the batches that a policy sees at its ticks."""
Watch = Callable[[Actions, Actions, NDArray[np.bool_]], None]
"""Called with all chunks (sample, tick, horizon, action_dim) of a batch, the recorded chunks and
their valid steps."""
Alter = Callable[[Batch], Batch]
"""Returns the batch that the policy sees; does not change its argument."""
_SEED = 0
_CHUNKS_AT_ONCE = 1024
"""The most chunks sampled in one forward pass, to bound the memory; but at least one a tick."""


@dataclass(frozen=True)
class Predictions:
    """Action chunks at `ticks`, in physical units: (tick, horizon, action_dim).

    `valid` (tick, horizon) is False beyond the end of an episode, where nothing was recorded.
    """

    ticks: Ticks
    episodes: NDArray[np.int64]
    """(tick,) index of each tick's episode in the store."""
    predicted: Actions
    """A stochastic policy's first sample, which a robot would execute."""
    recorded: Actions
    valid: NDArray[np.bool_]
    sampled: Actions | None = None
    """The absolute error of a sample, averaged over independent samples; None with one sample."""

    @property
    def error(self) -> Actions:
        """The absolute error of one chunk of the policy, (tick, horizon, action_dim)."""
        if self.sampled is not None:
            return self.sampled
        return np.abs(self.predicted - self.recorded)


def predict(
    policy: Trainable,
    store: FeatureStore,
    ticks: Ticks,
    windows: Windows,
    batch_size: int,
    progress: bool = False,
    samples: int = 1,
    feed: FeedMaker | None = None,
    watch: Watch | None = None,
    lags: Lags = NO_LAGS,
    alter: Alter | None = None,
) -> Predictions:
    """The policy's chunks at these ticks, in evaluation mode, beside the recorded chunks.

    A robot executes one sample, so a stochastic policy's error is the mean of the errors of
    `samples` independent samples, never the error of their mean. One generator of fixed seed draws
    the noise of all batches: the same weights, ticks, `samples` and `batch_size` give the same
    figures; another `batch_size` changes those of a stochastic policy. Runs on the policy's device,
    on the batches of `feed`, by default the store's. Streams are `lags` late, and the policy sees
    what `alter` makes of a batch. `watch` is called with all samples. `progress` shows a bar on a
    terminal. Raises `NumericsError`, naming episode, tick and time, where a prediction or a
    recorded action is NaN or infinite.
    """
    device = next(policy.parameters()).device
    # On the CPU, so that every device gets the same noise.
    generator = Generator().manual_seed(_SEED)
    plan = [replace(indices, lags=lags) for indices in cut_batches(ticks, batch_size)]
    predicted, recorded, valid, sampled = [], [], [], []
    with (
        torch.inference_mode(),
        Prefetch(store, plan, windows, device) if feed is None else feed(plan) as batches,
        tqdm(
            total=len(ticks), desc="predicting", unit="tick", disable=None if progress else True
        ) as bar,
    ):
        for indices, batch in batches:
            at = indices.ticks
            chunks = _sample(policy, alter(batch) if alter else batch, samples, generator)
            predicted.append(chunks[0])
            recorded.append(batch.action.cpu().numpy().copy())
            valid.append(batch.action_valid.cpu().numpy().astype(bool))
            _check_finite(store, at, recorded[-1], valid[-1], chunks)
            if len(chunks) > 1:
                sampled.append(np.abs(chunks - recorded[-1]).mean(axis=0))
            if watch is not None:
                watch(chunks, recorded[-1], valid[-1])
            bar.update(len(at))
    return Predictions(
        ticks=ticks,
        episodes=store.episode_of(ticks),
        predicted=np.concatenate(predicted),
        recorded=np.concatenate(recorded),
        valid=np.concatenate(valid),
        sampled=np.concatenate(sampled) if sampled else None,
    )


def _sample(
    policy: Trainable, batch: Batch, samples: int, generator: Generator
) -> Float[np.ndarray, "sample tick horizon action_dim"]:
    """Independent chunks of each tick in float32; a single one if the policy is not stochastic."""
    samples = samples if policy.stochastic else 1
    at_once = max(1, _CHUNKS_AT_ONCE // len(batch))
    parts = [
        policy.sample(batch, min(at_once, samples - done), generator).float().cpu().numpy()
        for done in range(0, samples, at_once)
    ]
    return np.concatenate(parts)


def _check_finite(
    store: FeatureStore,
    ticks: Ticks,
    recorded: Actions,
    valid: NDArray[np.bool_],
    chunks: Float[np.ndarray, "sample tick horizon action_dim"],
) -> None:
    """A recorded action has a tick of its own; a prediction has the tick it was made at."""
    own = ticks[:, None] + np.arange(recorded.shape[1])
    steps = recorded.reshape(own.size, -1)
    check_finite(store, "tick", own.ravel(), "recorded action", steps, valid.ravel())
    made_at = np.repeat(ticks, recorded.shape[1])
    for chunk in chunks:
        check_finite(store, "tick", made_at, "action of the policy", chunk.reshape(steps.shape))
