"""Which way a store reaches a training: mapped, or on its device."""

from dataclasses import dataclass
from typing import Literal

import torch

from pipeline.base.format import size
from pipeline.store import FeatureStore
from pipeline.store.gather import WIDE
from pipeline.store.mapping import fitting
from pipeline.store.memory import available_bytes

FeedName = Literal["auto", "mapped", "device"]
_DEVICE_SHARE = 0.6
"""Of the device's free memory, what a store may fill: the rest is for the model and its step."""


@dataclass(frozen=True)
class Choice:
    """How batches are made."""

    feed: FeedName
    on_device: frozenset[str]
    """The wide fields of a batch whose arrays live on the device."""
    why: str
    """In a line, for the user."""


def choose_feed(
    feed: FeedName, store: FeatureStore, device: torch.device, free: int | None = None
) -> Choice:
    """What of an open store lives on the device, and why; `free` bytes there, measured if None.

    `device` takes the streams that fit, the smallest first; `auto` takes a GPU if all fit.
    """
    if feed == "mapped":
        return Choice(feed, frozenset(), "feed: mapped, as train_head.feed says")
    if feed == "auto" and device.type != "cuda":
        return Choice("mapped", frozenset(), f"feed: mapped (auto: training runs on the {device})")
    free = _free_bytes(device) if free is None else free
    wide = {name: store.tensor(name) for name in WIDE if store.tensor(name).nbytes}
    fields = fitting(wide, free, _DEVICE_SHARE)
    whole, taken = sum(one.nbytes for one in wide.values()), sum(wide[one].nbytes for one in fields)
    room = (
        f"{size(taken)} of {size(whole)} fit in {_DEVICE_SHARE:.0%} of the "
        f"{size(free)} free on {device}"
    )
    if feed == "auto" and taken < whole:
        return Choice("mapped", frozenset(), f"feed: mapped (auto: {room})")
    said = "auto" if feed == "auto" else "as train_head.feed says"
    streams = ", ".join(fields) or "nothing"
    return Choice("device", frozenset(fields), f"feed: device ({said}; {room}: {streams})")


def _free_bytes(device: torch.device) -> int:
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    return available_bytes()
