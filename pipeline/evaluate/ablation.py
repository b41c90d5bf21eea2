"""Is a stream used? A policy judged again and again, with one of its streams spoilt each time.

An error that stays says that the policy does not use the stream, or that others tell it the same.
"""

from dataclasses import dataclass

import numpy as np
import torch
from tqdm import tqdm

from pipeline.evaluate.corruption import (
    FIELDS,
    Alter,
    donors_of,
    exchanged,
    feed_maker,
    missing,
    zeroed,
)
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.policy import Policy
from pipeline.store import FeatureStore, episode_name
from pipeline.train.batches import Lags, Ticks, Windows
from pipeline.train.predictions import FeedMaker
from pipeline.train.scores import Comparison, evaluate_policy

DELAYS_MS = (50, 100, 200)
MOST_TICKS = 1000
"""Held-out ticks judged: every way to spoil a stream costs a pass over them."""
MOST_SAMPLES = 4
"""Chunks a tick of a stochastic policy whose mean is judged, for the same reason."""


@dataclass(frozen=True)
class Ablated:
    """A policy judged with one stream spoilt."""

    stream: str
    how: str
    """`zeroed`, `missing`, `shuffled` or `delayed 50 ms`."""
    comparison: Comparison


@dataclass(frozen=True)
class ModalityStudy:
    """A policy judged on the same ticks with all streams intact and with each one spoilt."""

    intact: Comparison
    spoilt: tuple[Ablated, ...]
    notes: tuple[str, ...]
    """What could not be judged as asked, and why."""
    samples: int
    """Chunks a tick whose mean was judged; 1 where the policy does not sample."""

    @property
    def streams(self) -> tuple[str, ...]:
        """The streams that the policy sees."""
        return tuple(dict.fromkeys(one.stream for one in self.spoilt))

    def times_intact(self, one: Ablated) -> float | None:
        """The error with a stream spoilt, as a multiple of the intact one; None where that is 0."""
        intact = self.intact.overall("policy")
        return one.comparison.overall("policy") / intact if intact > 0 else None


def judge_modalities(
    checkpoint: PolicyCheckpoint,
    policy: Policy,
    store: FeatureStore,
    ticks: Ticks,
    batch_size: int,
    samples: int = 1,
    progress: bool = False,
) -> ModalityStudy | None:
    """The study of this policy, which is `checkpoint.policy()`, on these held-out ticks.

    At most `MOST_TICKS` evenly spaced ones are taken, of those so far into their episode that the
    longest delay stays inside it; None where there is no such tick. Of a stochastic policy, the
    mean of `samples` chunks, but of `MOST_SAMPLES` at most. Every judgement draws from the same
    seed, so that the same noise stands on both sides of a difference. Raises as `judge` does.
    """
    samples = min(samples, MOST_SAMPLES) if policy.stochastic else 1
    settled = _settled(store, ticks)
    if not len(settled):
        return None
    notes: list[str] = []
    if len(settled) < len(ticks):
        notes.append(
            f"intact is not the error above: {len(ticks) - len(settled)} of {len(ticks)} held-out "
            "ticks are left out, so near their episode's start that a delay would reach beyond it"
        )
    ticks = _spaced(settled)
    spoiler = _Spoiler(checkpoint, store, ticks, next(policy.parameters()).device)
    ways: list[tuple[str, str, FeedMaker | None]] = [("", "intact", None)]
    for stream in (stream for stream in FIELDS if stream in policy.encoders):
        found, said = spoiler.ways(stream)
        ways += [(stream, how, feed) for how, feed in found.items()]
        notes += said
    comparisons = [
        evaluate_policy(
            policy,
            store,
            ticks,
            spoiler.windows,
            batch_size,
            checkpoint.normalization,
            samples=samples,
            feed=feed,
        )[0]
        for *_, feed in tqdm(
            ways, desc="spoiling streams", unit="way", disable=None if progress else True
        )
    ]
    spoilt = (
        Ablated(stream, how, comparison)
        for (stream, how, _), comparison in zip(ways[1:], comparisons[1:], strict=True)
    )
    return ModalityStudy(comparisons[0], tuple(spoilt), tuple(notes), samples)


@dataclass(frozen=True)
class _Spoiler:
    """The ways to spoil the streams of a store for a policy at some ticks."""

    checkpoint: PolicyCheckpoint
    store: FeatureStore
    ticks: Ticks
    device: torch.device

    @property
    def windows(self) -> Windows:
        return Windows.of(self.checkpoint.params)

    def ways(self, stream: str) -> tuple[dict[str, FeedMaker], list[str]]:
        """Feeds by what they do to the stream, and why one is not there or not as asked."""
        found, notes = {}, []
        statistics = getattr(self.checkpoint.normalization, stream)
        assert statistics is not None, "a policy has statistics of each stream that it sees"
        found["zeroed"] = self._altered(zeroed(stream, statistics.mean))
        if self._knows_missing(stream):
            found["missing"] = self._altered(missing(stream))
        else:
            notes.append(
                f"{stream} missing: not judged, for in training it never was (train_head."
                f"drop_{stream} 0), so that the embedding for it has learned nothing"
            )
        donors = donors_of(self.store, self.ticks, stream)
        if donors is None:
            notes.append(f"{stream} shuffled: not judged, it takes two held-out episodes with it")
        else:
            found["shuffled"] = self._altered(
                exchanged(stream, self.store, self.windows, self.ticks, donors)
            )
        for how, lags in delays(self.store, stream).items():
            found[how] = feed_maker(self.store, self.windows, self.device, lags)
        if stream == "features":
            notes += _rounded_delays(self.store)
        return found, notes

    def _altered(self, alter: Alter) -> FeedMaker:
        return feed_maker(self.store, self.windows, self.device, alter=alter)

    def _knows_missing(self, stream: str) -> bool:
        """Whether training showed the policy what it is like without this stream."""
        if getattr(self.checkpoint.params, f"drop_{stream}") > 0:
            return True
        if stream == "features":
            return False
        count = np.diff(self.store.array(f"episode/{stream}_start"))
        held_out = self.checkpoint.held_out_ticks
        return any(
            not count[episode.index] and episode_name(episode) not in held_out
            for episode in self.store.episodes
        )


def delays(store: FeatureStore, stream: str) -> dict[str, Lags]:
    """The lags of `DELAYS_MS` by name.

    Features go back whole VL rows, at least one: the names say the ms that this is, each once.
    """
    if stream != "features":
        return {
            f"delayed {ms} ms": Lags(sensor_s=ms / 1000)
            if stream == "sensor"
            else Lags(state_s=ms / 1000)
            for ms in DELAYS_MS
        }
    row_ms = _row_ms(store)
    rows = sorted({max(1, round(ms / row_ms)) for ms in DELAYS_MS})
    return {f"delayed {count * row_ms:.0f} ms": Lags(features=count) for count in rows}


def _rounded_delays(store: FeatureStore) -> list[str]:
    """Why features are not delayed by what was asked; nothing where they are."""
    had = delays(store, "features")
    other = [f"{ms}" for ms in DELAYS_MS if f"delayed {ms} ms" not in had]
    if not other:
        return []
    judged = ", ".join(how.removeprefix("delayed ") for how in had)
    return [
        f"features delayed: they change every {_row_ms(store):.0f} ms only (vlm_reuse_count "
        f"{store.vlm_reuse_count}) and go back whole VL rows, at least one: judged {judged}; "
        f"{', '.join(other)} ms end within a row"
    ]


def _row_ms(store: FeatureStore) -> float:
    """Time between VL rows."""
    return 1000 * store.vlm_reuse_count * _tick_s(store)


def _tick_s(store: FeatureStore) -> float:
    """Time between ticks of an episode; where the recorded rows are the ticks, its median."""
    step_s = store.tick_step() if store.action_hz is None else 1 / store.action_hz
    return step_s if step_s > 0 else np.inf  # no episode has two ticks: none can be delayed


def _settled(store: FeatureStore, ticks: Ticks) -> Ticks:
    """The ticks at which every delay still finds something of their own episode."""
    episode = store.episode_of(ticks)
    time_s, row = store.array("tick/time"), store.array("tick/vl_row")
    since_s = time_s[ticks] - time_s[store.array("episode/tick_start")[episode]]
    rows = row[ticks] - store.array("episode/vl_start")[episode]
    most = max(lags.features for lags in delays(store, "features").values())
    return ticks[(since_s > max(DELAYS_MS) / 1000) & (rows >= most)]


def _spaced(ticks: Ticks) -> Ticks:
    """At most `MOST_TICKS` of them, evenly."""
    count = min(len(ticks), MOST_TICKS)
    return ticks[np.linspace(0, len(ticks) - 1, count).round().astype(np.int64)]
