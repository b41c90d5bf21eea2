"""Batches of a store on their way to a policy.

`draw` says what a batch is made of; `prefetch` gathers ahead of time; `resident` holds streams on
the device; `choice` picks between these ways.
"""

from pipeline.train.batches.batch_indices import (
    NO_LAGS,
    BatchIndices,
    Feed,
    Lags,
    Ticks,
    Windows,
    draws,
)
from pipeline.train.batches.choice import Choice, FeedName, choose_feed
from pipeline.train.batches.device_store import DeviceStore
from pipeline.train.batches.prefetch import Prefetch

__all__ = [
    "NO_LAGS",
    "BatchIndices",
    "Choice",
    "DeviceStore",
    "Feed",
    "FeedName",
    "Lags",
    "Prefetch",
    "Ticks",
    "Windows",
    "choose_feed",
    "draws",
]
