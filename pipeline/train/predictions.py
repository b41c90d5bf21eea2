"""What a policy does at recorded ticks, and what simple rules would have done there."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor
from tqdm import tqdm

from pipeline.base.errors import NumericsError
from pipeline.base.finite import first_non_finite
from pipeline.policy.policy import Trainable
from pipeline.store import Batch, FeatureStore, place
from pipeline.train.batches import BatchIndices, Prefetch, Ticks, Windows, cut_batches

Actions = NDArray[np.float32]
METHODS = ("policy", "zero_action", "mean_action", "repeat_last")
BASELINES = METHODS[1:]
FeedMaker = Callable[
    [Sequence[BatchIndices]], AbstractContextManager[Iterable[tuple[BatchIndices, Batch]]]
]
"""Makes the feed of a plan: what a policy is to see at these ticks."""
_SEED = 0
_CHUNKS_AT_ONCE = 1024
"""Chunks sampled in one forward pass at most, but one a tick: what bounds the memory."""


@dataclass(frozen=True)
class Predictions:
    """Action chunks at `ticks`, in physical units: (tick, horizon, action_dim).

    `valid` (tick, horizon) is False beyond the end of an episode, where nothing was recorded.
    """

    ticks: Ticks
    episodes: NDArray[np.int64]
    """(tick,) index of each tick's episode in the store."""
    predicted: Actions
    recorded: Actions
    valid: NDArray[np.bool_]


def predict(
    policy: Trainable,
    store: FeatureStore,
    ticks: Ticks,
    windows: Windows,
    batch_size: int,
    progress: bool = False,
    samples: int = 1,
    feed: FeedMaker | None = None,
) -> Predictions:
    """What the policy, in evaluation mode, does at these ticks, beside what was recorded.

    Of a stochastic policy, the mean of `samples` chunks; any other gives one. Their noise comes
    from one generator of fixed seed, batch after batch: the same weights give the same figures for
    the same ticks, `samples` and `batch_size`, and a stochastic policy others for another
    `batch_size`. Runs on the policy's device, which sees what `feed` hands out: by default the
    store as it is, gathered ahead. `progress` shows a bar on a terminal. Raises `NumericsError`,
    naming episode, tick and time, where a prediction or a recorded action is NaN or infinite.
    """
    device = next(policy.parameters()).device
    # On the CPU, so that every device is given the same noise.
    generator = Generator().manual_seed(_SEED)
    plan = cut_batches(ticks, batch_size)
    predicted, recorded, valid = [], [], []
    with (
        torch.inference_mode(),
        Prefetch(store, plan, windows, device) if feed is None else feed(plan) as batches,
        tqdm(
            total=len(ticks), desc="predicting", unit="tick", disable=None if progress else True
        ) as bar,
    ):
        for indices, batch in batches:
            at = indices.ticks
            action = _mean_chunk(policy, batch, samples, generator)
            predicted.append(action.float().cpu().numpy())
            recorded.append(batch.action.cpu().numpy().copy())
            valid.append(batch.action_valid.cpu().numpy().astype(bool))
            _check_finite(store, at, recorded[-1], "recorded action", valid[-1])
            _check_finite(store, at, predicted[-1], "action of the policy")
            bar.update(len(at))
    return Predictions(
        ticks=ticks,
        episodes=store.episode_of(ticks),
        predicted=np.concatenate(predicted),
        recorded=np.concatenate(recorded),
        valid=np.concatenate(valid),
    )


def baselines(
    store: FeatureStore, predictions: Predictions, mean_action: NDArray[np.floating]
) -> dict[str, Actions]:
    """What three rules that see nothing would have done: name -> (tick, 1, action_dim).

    `zero_action`: no motion. `mean_action`: the mean over the training ticks. `repeat_last`: the
    action of the tick before, the whole chunk long; at an episode's first tick, which has none
    before it, zero where actions are deltas or velocities, and the mean training action where they
    are absolute: zero would be a pose far from all others.
    """
    ticks = predictions.ticks
    action = store.array("tick/action")
    first = ticks == store.array("episode/tick_start")[predictions.episodes]
    mean = np.asarray(mean_action, np.float32)
    start = mean if store.streams["action"]["kind"] == "absolute" else np.zeros_like(mean)
    last = np.where(first[:, None], start, action[np.maximum(ticks - 1, 0)])
    zero = np.zeros((len(ticks), 1, action.shape[1]), np.float32)
    return {
        "zero_action": zero,
        "mean_action": zero + mean,
        "repeat_last": last[:, None],
    }


def _mean_chunk(policy: Trainable, batch: Batch, samples: int, generator: Generator) -> Tensor:
    """The mean of the sampled chunks, (tick, horizon, action_dim), in float32."""
    samples = samples if policy.stochastic else 1
    at_once = max(1, _CHUNKS_AT_ONCE // len(batch))
    total: Tensor | float = 0.0
    for done in range(0, samples, at_once):
        chunks = policy.sample(batch, min(at_once, samples - done), generator)
        total = total + chunks.float().sum(dim=0)
    assert isinstance(total, Tensor)
    return total / samples


def _check_finite(
    store: FeatureStore,
    ticks: Ticks,
    actions: Actions,
    what: str,
    valid: NDArray[np.bool_] | None = None,
) -> None:
    bad = first_non_finite(actions, valid)
    if bad is not None:
        row, ahead, dimension = bad
        # What was recorded lies at a tick of its own; what is predicted, at the tick it is of.
        tick = int(ticks[row]) + (0 if valid is None else ahead)
        name = store.streams["action"]["names"][dimension]
        raise NumericsError(
            f"{place(store, 'tick', tick)} of {store.path}: expected finite numbers, found "
            f"{actions[bad]} as the {what} ({name}). Look at what was recorded "
            "there, mend or leave out the recording and run stages.extract again."
        )
