"""Batches ahead of time: a background thread gathers into a few reused buffers.

A fresh output for every batch costs more in page faults than the gather itself, and a gather
between two steps makes the device wait; one thread and two buffers remove both.
"""

import queue
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import astuple, dataclass
from typing import Self

import torch

from pipeline.store import Batch, FeatureStore
from pipeline.store.gather import Selection
from pipeline.train.batches.batch_indices import NO_LAGS, BatchIndices, Lags, Windows
from pipeline.train.batches.device_store import DeviceStore


@dataclass
class _Buffer:
    """A reused host batch, and the copy out of it that has to end before it is filled again."""

    batch: Batch | None = None
    selection: Selection | None = None
    """Where what the batch still lacks lies on the device."""
    whole: Batch | None = None
    """With that too; on CUDA only made when it is handed out."""
    copied: torch.cuda.Event | None = None


class Prefetch(Iterator[tuple[BatchIndices, Batch]]):
    """Hands out `(draw, batch)` for each draw of `plan`, in its order.

    The plan is consumed in the background thread, at most `buffers` draws ahead. On the CPU a
    batch stays as it is until the next one is asked for; on CUDA it is a copy on the device, made
    from pinned memory, that is never overwritten. An exception in the plan or in the store comes
    out of `next` at the batch it belongs to. Use as a context manager, or call `close`. The thread
    does not survive a fork: a forked process reads from the same store with a `Prefetch` it makes.

    What `resident` holds of the store is gathered on its device, into fresh memory; on CUDA when
    the batch is handed out, in the order of the consumer's stream. The rest of the store is read
    into memory in the background, as far as it fits.
    """

    def __init__(
        self,
        store: FeatureStore,
        plan: Iterable[BatchIndices],
        windows: Windows,
        device: torch.device,
        buffers: int = 2,
        lags: Lags = NO_LAGS,
        resident: DeviceStore | None = None,
    ) -> None:
        assert buffers >= 2, "one buffer in use, one being filled"
        self.waited_s = 0.0
        """Time that the consumer has spent waiting for data."""
        self._store = store
        self._windows = windows
        self._lags = lags
        self._device = device
        self._resident = resident
        self._on_device = frozenset[str]() if resident is None else resident.fields
        self._free: queue.SimpleQueue[_Buffer | None] = queue.SimpleQueue()
        self._filled: queue.SimpleQueue[tuple[BatchIndices, _Buffer] | BaseException | None] = (
            queue.SimpleQueue()
        )
        self._in_use: _Buffer | None = None
        self._ended = False
        for _ in range(buffers):
            self._free.put(_Buffer())
        self._closing = threading.Event()
        self._thread = threading.Thread(
            target=self._work, args=(plan,), name="prefetch", daemon=True
        )
        self._thread.start()

    def __next__(self) -> tuple[BatchIndices, Batch]:
        if self._ended:
            raise StopIteration
        self._release()
        started = time.perf_counter()
        item = self._filled.get()
        self.waited_s += time.perf_counter() - started
        if not isinstance(item, tuple):
            self.close()
            if item is None:
                raise StopIteration
            raise item
        draw, self._in_use = item
        started = time.perf_counter()
        batch = self._deliver(self._in_use)
        self.waited_s += time.perf_counter() - started
        return draw, batch

    def close(self) -> None:
        """Stop the thread and wait for it; the last batch handed out stays valid."""
        self._ended = True
        self._closing.set()
        self._free.put(None)
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def _deliver(self, buffer: _Buffer) -> Batch:
        if self._device.type == "cpu":
            assert buffer.whole is not None
            return buffer.whole
        delivered = self._complete(buffer).to(self._device, non_blocking=True)
        buffer.copied = torch.cuda.Event()
        buffer.copied.record(torch.cuda.current_stream(self._device))
        return delivered

    def _complete(self, buffer: _Buffer) -> Batch:
        assert buffer.batch is not None and buffer.selection is not None
        if self._resident is None:
            return buffer.batch
        return self._resident.complete(buffer.batch, buffer.selection)

    def _release(self) -> None:
        if self._in_use is not None:
            self._free.put(self._in_use)
            self._in_use = None

    def _work(self, plan: Iterable[BatchIndices]) -> None:
        try:
            self._store.warm(but=self._on_device)
            for draw in plan:
                buffer = self._free.get()
                if buffer is None or self._closing.is_set():
                    return
                self._fill(buffer, draw)
                self._filled.put((draw, buffer))
            self._filled.put(None)
        except BaseException as error:  # it belongs to the thread that asks for the batch
            self._filled.put(error)

    def _fill(self, buffer: _Buffer, draw: BatchIndices) -> None:
        if buffer.copied is not None:
            buffer.copied.synchronize()
        windows, count = astuple(self._windows), len(draw.ticks)
        if buffer.batch is None or len(buffer.batch) != count:
            empty = self._store.empty_batch(count, *windows, but=self._on_device)
            buffer.batch = empty.pin() if self._device.type == "cuda" else empty.touch()
        _, buffer.selection = self._store.select(
            draw.ticks, windows, astuple(self._lags), buffer.batch, draw.variants
        )
        self._store.copy(buffer.selection, buffer.batch, but=self._on_device)
        if self._device.type == "cpu":
            buffer.whole = self._complete(buffer)
