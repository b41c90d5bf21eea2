"""Batches of which a policy sees one stream otherwise than it was recorded."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, replace
from types import TracebackType
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.store import Batch, FeatureStore
from pipeline.train.batches import NO_LAGS, BatchIndices, Feed, Lags, Prefetch, Ticks, Windows
from pipeline.train.predictions import FeedMaker

Alter = Callable[[BatchIndices, Batch], Batch]
"""A batch as the policy is to see it; the one it is given stays as it is."""

FIELDS = {
    "sensor": ("sensor", "sensor_valid"),
    "state": ("state", "state_valid"),
    "features": ("features", "slot_valid", "feature_age"),
}
"""What belongs to each stream: its values, which of them are real, and of features their age."""


class Altered:
    """A feed that alters each batch of another, once, before anyone sees it."""

    def __init__(self, feed: Feed, alter: Alter) -> None:
        self.waited_s = 0.0
        """Time that the consumer has spent waiting for data."""
        self._feed = feed
        self._alter = alter

    def __enter__(self) -> Self:
        self._feed.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._feed.__exit__(kind, error, trace)

    def __iter__(self) -> Iterator[tuple[BatchIndices, Batch]]:
        for draw, batch in self._feed:
            self.waited_s = self._feed.waited_s
            yield draw, self._alter(draw, batch)


def feed_maker(
    store: FeatureStore,
    windows: Windows,
    device: torch.device,
    lags: Lags = NO_LAGS,
    alter: Alter | None = None,
) -> FeedMaker:
    """Feeds of this store in which streams come late or are altered."""

    def make(plan: Sequence[BatchIndices]) -> Feed:
        feed = Prefetch(store, plan, windows, device, lags=lags)
        return feed if alter is None else Altered(feed, alter)

    return make


def zeroed(stream: str, mean: NDArray[np.floating]) -> Alter:
    """Every value of the stream at its training mean, which the policy sees as zeros.

    A raw 0 would be a reading far from all others (a pose at the robot's foot, light of no
    intensity): the error would tell how the policy extrapolates, not what it does without knowing.
    """

    def alter(draw: BatchIndices, batch: Batch) -> Batch:
        values = getattr(batch, stream)
        level = torch.tensor(mean, dtype=torch.float32, device=values.device)
        return replace(batch, **{stream: level.expand(values.shape)})

    return alter


def missing(stream: str) -> Alter:
    """Nothing of the stream is real: the policy's encoder gives its embedding for that."""
    valid = FIELDS[stream][1]

    def alter(draw: BatchIndices, batch: Batch) -> Batch:
        return replace(batch, **{valid: torch.zeros_like(getattr(batch, valid))})

    return alter


def exchanged(
    stream: str, store: FeatureStore, windows: Windows, ticks: Ticks, donors: Ticks
) -> Alter:
    """Tick `ticks[i]` sees the stream as it is at tick `donors[i]`; `ticks` ascend."""

    def alter(draw: BatchIndices, batch: Batch) -> Batch:
        here = donors[np.searchsorted(ticks, draw.ticks)]
        other = store.gather(here, *astuple(windows)).to(batch.action.device)
        return replace(batch, **{name: getattr(other, name) for name in FIELDS[stream]})

    return alter


def donors_of(store: FeatureStore, ticks: Ticks, stream: str, seed: int = 0) -> Ticks | None:
    """For each of these ascending ticks, one of another episode among them, drawn evenly.

    A tick whose episode lacks the stream gives it to nobody and keeps what it has. None where
    fewer than two episodes have the stream.
    """
    episode = store.episode_of(ticks)
    having = ticks
    if stream != "features":
        count = np.diff(store.array(f"episode/{stream}_start"))
        having = ticks[count[episode] > 0]
        episode = episode[count[episode] > 0]
    first = np.searchsorted(episode, episode, side="left")
    size = np.searchsorted(episode, episode, side="right") - first
    if len(having) == 0 or (size == len(having)).any():
        return None
    # A place among the ticks of other episodes: what lies behind one's own moves up by its size.
    drawn = np.random.default_rng(seed).integers(0, len(having) - size)
    drawn = np.where(drawn < first, drawn, drawn + size)
    donors = ticks.copy()
    donors[np.searchsorted(ticks, having)] = having[drawn]
    return donors
