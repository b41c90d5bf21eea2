"""Streams of a store that live on a device, and are gathered there."""

from collections.abc import Collection
from dataclasses import replace
from typing import NoReturn

import torch
from torch import Tensor
from tqdm import tqdm

from pipeline.store import Batch, FeatureStore
from pipeline.store.gather import Index, Selection, Window

_UPLOAD_BYTES = 64 * 2**20


class DeviceStore:
    """The arrays of these wide fields of a store (`pipeline.store.gather.WIDE`) on a device.

    Copied once, with a progress bar. Which rows a batch is made of is worked out on the host: a few
    small index tensors are all that is sent for a batch.
    """

    def __init__(self, store: FeatureStore, fields: Collection[str], device: torch.device) -> None:
        sources = {name: store.tensor(name) for name in sorted(fields)}
        sources = {name: source for name, source in sources.items() if source.nbytes}
        self.fields = frozenset(sources)
        """What lives there; of a stream that the store lacks there is nothing to hold."""
        self._device = device
        total = sum(source.nbytes for source in sources.values())
        with tqdm(
            total=total, desc=f"store to {device}", unit="B", unit_scale=True, disable=None
        ) as bar:
            self._tensors = {name: _upload(s, device, bar) for name, s in sources.items()}

    def complete(self, batch: Batch, selection: Selection) -> Batch:
        """The batch with what lives here, on the device; the rest of it stays where it is.

        On CUDA nothing is waited for: the work joins the current stream.
        """
        found: dict[str, Tensor] = {}
        for name in self.fields & selection.rows.keys():
            shape = getattr(batch, name).shape
            index = self._send(selection.rows[name])
            found[name] = self._tensors[name].index_select(0, index).view(shape)
        for name in self.fields & selection.windows.keys():
            length = getattr(batch, name).shape[1]
            found[name] = self._window(self._tensors[name], selection.windows[name], length)
        return replace(batch, **found)

    def _window(self, readings: Tensor, window: Window, length: int) -> Tensor:
        """(batch, window, channel), zeros before the first real reading."""
        place = torch.arange(length, device=self._device)
        rows = (self._send(window.end)[:, None] + place - length).clamp_(min=0)
        found = readings.index_select(0, rows.view(-1)).view(*rows.shape, -1)
        if len(rows) and int(window.valid.min()) < length:
            before = place < length - self._send(window.valid)[:, None]
            found.masked_fill_(before[..., None], 0)
        return found

    def _send(self, index: Index) -> Tensor:
        host = torch.from_numpy(index)
        if self._device.type == "cuda":
            host = host.pin_memory()
        return host.to(self._device, non_blocking=True)


def _upload(source: Tensor, device: torch.device, bar: "tqdm[NoReturn]") -> Tensor:
    """A copy of a map, made piece by piece: the map is read in order, and the bar moves."""
    there = torch.empty(source.shape, dtype=source.dtype, device=device)
    rows = max(1, _UPLOAD_BYTES * len(source) // max(1, source.nbytes))
    for start in range(0, len(source), rows):
        there[start : start + rows].copy_(source[start : start + rows])
        bar.update(there[start : start + rows].nbytes)
    return there
