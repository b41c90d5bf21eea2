"""Which streams a policy uses: it is evaluated again, each time with one of its streams ablated.

If the error stays the same, the policy does not use the stream, or other streams tell it the same.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.evaluate.baselines import Baselines
from pipeline.evaluate.figures import Figure, times
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.policy import Policy
from pipeline.store import Batch, FeatureStore
from pipeline.train.batches import NO_LAGS, Lags, Ticks, Windows, evenly
from pipeline.train.predictions import Alter, predict
from pipeline.train.scores import Comparison, action_space, compare
from pipeline.train.training_data import groups_of

DELAYS_MS = (50, 100, 200)
MOST_TICKS = 1000
"""The most test ticks: every way to ablate a stream costs a pass over them."""
MOST_SAMPLES = 4
"""The most chunks a tick of a stochastic policy, for the same reason; their errors are averaged."""
STREAMS = ("sensor", "state", "features")


@dataclass(frozen=True)
class Ablated:
    """A policy evaluated with one stream ablated."""

    stream: str
    how: str
    """`zeroed` or `delayed 50 ms`."""
    comparison: Comparison
    intact: Comparison
    """The policy with all streams, on the same ticks: those whose episode has this stream."""


@dataclass(frozen=True)
class AblationStudy:
    """A policy evaluated on the same ticks with all streams intact and with each one ablated."""

    intact: Comparison
    ablated: tuple[Ablated, ...]
    notes: tuple[str, ...]
    """What was left out or evaluated in another way, and why."""
    samples: int
    """The number of chunks a tick whose errors were averaged; 1 if the policy does not sample."""

    def times_intact(self, ablated: Ablated) -> Figure | None:
        """The error with a stream ablated, in multiples of the intact one; None where that is 0."""
        return times(ablated.comparison, ablated.intact)


def evaluate_ablation(
    checkpoint: PolicyCheckpoint,
    policy: Policy,
    store: FeatureStore,
    ticks: Ticks,
    baselines: Baselines,
    batch_size: int,
    samples: int = 1,
) -> AblationStudy | None:
    """The study of this policy, which is `checkpoint.policy()`, on these test ticks.

    It uses at most `MOST_TICKS` evenly spaced ticks, and only ticks from which the longest delay
    stays inside the episode; None if there is no such tick. The error of a stochastic policy is
    averaged over `samples` chunks, `MOST_SAMPLES` at most. Every evaluation draws from the same
    seed, so both sides of a difference have the same noise. Raises as `predict` does.
    """
    samples = min(samples, MOST_SAMPLES) if policy.stochastic else 1
    settled = _settled(store, ticks)
    if not len(settled):
        return None
    left_out = len(ticks) - len(settled)
    notes = [
        f"intact is not the error above: {left_out} of {len(ticks)} test ticks are left "
        "out, so near their episode's start that a delay would reach beyond it"
    ] * (left_out > 0)
    ticks = evenly(settled, MOST_TICKS)
    ways: list[tuple[str, str, Ticks, Lags, Alter | None]] = [("", "intact", ticks, NO_LAGS, None)]
    for stream in (stream for stream in STREAMS if stream in policy.encoders):
        having = ticks[_having(store, ticks, stream)]
        if len(having) < len(ticks):
            notes.append(
                f"{stream}: judged on the {len(having)} of {len(ticks)} ticks whose episode has it"
            )
        if not len(having):
            continue
        if len(having) < len(ticks):
            ways.append((stream, "intact", having, NO_LAGS, None))
        alter = zeroed(stream, checkpoint.typical(stream))
        ways.append((stream, "zeroed", having, NO_LAGS, alter))
        ways += [(stream, how, having, lags, None) for how, lags in delays(store, stream).items()]
        if stream == "features":
            notes.append(f"features delayed: by whole VL rows, of {_row_ms(store):.0f} ms each")
    space = action_space(store, checkpoint.normalization)
    intact: dict[str, Comparison] = {}
    ablated: list[Ablated] = []
    windows = Windows.of(checkpoint.params)
    for stream, how, here, lags, alter in tqdm(ways, "ablating streams", unit="way", disable=None):
        predictions = predict(
            policy, store, here, windows, batch_size, samples=samples, lags=lags, alter=alter
        )
        groups = groups_of(store, checkpoint, here)
        comparison = compare(predictions, baselines.act(here), space, groups)
        if how == "intact":
            intact[stream] = comparison
        else:
            ablated.append(Ablated(stream, how, comparison, intact.get(stream, intact[""])))
    return AblationStudy(intact[""], tuple(ablated), tuple(notes), samples)


def zeroed(stream: str, mean: NDArray[np.floating]) -> Alter:
    """Every value of the stream at its training mean, which the policy sees as zeros.

    A raw 0 would be a reading far from all others (a pose at the robot's foot, no light): the error
    would show how the policy extrapolates, not how it does without the stream.
    """

    def alter(batch: Batch) -> Batch:
        values = getattr(batch, stream)
        level = torch.tensor(mean, dtype=torch.float32, device=values.device)
        return replace(batch, **{stream: level.expand(*values.shape[:-1], level.shape[-1])})

    return alter


def _having(store: FeatureStore, ticks: Ticks, stream: str) -> NDArray[np.bool_]:
    """(tick,) whether its episode has the stream."""
    if stream == "features":
        return np.full(len(ticks), True)
    return np.diff(store.array(f"episode/{stream}_start"))[store.episode_of(ticks)] > 0


def delays(store: FeatureStore, stream: str) -> dict[str, Lags]:
    """The lags of `DELAYS_MS` by name.

    Features go back whole VL rows, at least one; the names have the ms of these rows.
    """
    if stream != "features":
        return {
            f"delayed {ms} ms": replace(NO_LAGS, **{f"{stream}_s": ms / 1000}) for ms in DELAYS_MS
        }
    row_ms = _row_ms(store)
    rows = sorted({max(1, round(ms / row_ms)) for ms in DELAYS_MS})
    return {f"delayed {count * row_ms:.0f} ms": Lags(features=count) for count in rows}


def _row_ms(store: FeatureStore) -> float:
    """Time between VL rows in ms; without `action_hz`, by the ticks' median step."""
    step_s = store.tick_step() if store.action_hz is None else 1 / store.action_hz
    # Where no episode has two ticks, none can be delayed.
    return 1000 * store.vlm_reuse_count * (step_s if step_s > 0 else np.inf)


def _settled(store: FeatureStore, ticks: Ticks) -> Ticks:
    """The ticks from which every delay stays inside their episode."""
    episode = store.episode_of(ticks)
    time_s, row = store.array("tick/time"), store.array("tick/vl_row")
    since_s = time_s[ticks] - time_s[store.array("episode/tick_start")[episode]]
    rows = row[ticks] - store.array("episode/vl_start")[episode]
    most = max(lags.features for lags in delays(store, "features").values())
    return ticks[(since_s > max(DELAYS_MS) / 1000) & (rows >= most)]
