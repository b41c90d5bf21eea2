"""Which way a store reaches a training: mapped, on its device, or out of an archive."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from pipeline.base.errors import ConfigError
from pipeline.base.format import size
from pipeline.base.memory import available_bytes
from pipeline.store import FeatureStore
from pipeline.store.archive import is_archive
from pipeline.store.gather import WIDE
from pipeline.store.mapping import fitting
from pipeline.store.repair_hints import restore_command
from pipeline.train.batches.scratch import restored

FeedName = Literal["auto", "mapped", "device", "compressed"]
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


def open_store(
    path: Path, feed: FeedName, scratch: Path | None, say: Callable[[str], None]
) -> FeatureStore:
    """The store at `path`; where an archive lies there, the store restored from it in `scratch`.

    It is restored once: what an earlier run has left there of the same content is used again.
    Raises `ConfigError` where `feed` and what lies there do not go together, and what
    `FeatureStore.open` and `restored` raise.
    """
    archived = is_archive(path)
    if archived and feed in ("mapped", "device"):
        raise ConfigError(
            f"train_head.feed is {feed}, which takes a store, but {path} is an archive. Set "
            "train_head.feed=auto to restore it to train_head.scratch, or make the store of it: "
            f"{restore_command(path)}"
        )
    if not archived and feed == "compressed" and path.exists():
        raise ConfigError(
            f"train_head.feed is compressed, which takes an archive, but {path} is none. Set "
            "train_head.feed=auto, or make an archive of it with stages.archive."
        )
    return FeatureStore.open(restored(path, scratch, say) if archived else path)


def choose_feed(
    feed: FeedName, store: FeatureStore, device: torch.device, free: int | None = None
) -> Choice:
    """What of an open store lives on the device, and why; `free` bytes there, measured if None.

    `device` takes the streams that fit, the smallest first; `auto` takes a GPU if all fit.
    """
    if feed in ("mapped", "compressed"):
        return Choice(feed, frozenset(), f"feed: {feed}, as train_head.feed says")
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
