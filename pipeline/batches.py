"""Batches ahead of time: a background thread gathers into a few reused buffers.

A fresh output for every batch costs more in page faults than the gather itself, and a gather
between two steps makes the device wait; one thread and two buffers remove both.
"""

import queue
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import astuple, dataclass
from types import TracebackType
from typing import Protocol, Self

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.config import TrainHeadParams
from pipeline.store import Batch, FeatureStore

Ticks = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Draw:
    """What one batch is made of."""

    ticks: Ticks
    """(batch,) store-global."""
    variants: NDArray[np.int64] | None = None
    """(batch,) which stored variant of its VL row each tick sees; None: all 0, the plain frames."""


def draws(ticks: Ticks, batch_size: int) -> list[Draw]:
    """The ticks in their order, `batch_size` at a time."""
    return [Draw(part) for part in np.split(ticks, range(batch_size, len(ticks), batch_size))]


@dataclass(frozen=True)
class Lags:
    """How late each stream is: `features` in whole VL rows, the others in seconds."""

    features: int = 0
    sensor_s: float = 0.0
    state_s: float = 0.0


NO_LAGS = Lags()


@dataclass(frozen=True)
class Windows:
    """How much of each stream a sample sees, in ticks (`horizon`) and readings."""

    horizon: int
    sensor_window: int
    state_window: int

    @classmethod
    def of(cls, params: TrainHeadParams) -> Self:
        """What this policy needs; of a stream whose encoder is off, a single reading."""
        return cls(
            params.horizon,
            params.sensor_window if params.sensor_enabled else 1,
            params.state_window if params.robot_state_enabled else 1,
        )


@dataclass
class _Buffer:
    """A reused host batch, and the copy out of it that has to end before it is filled again."""

    batch: Batch | None = None
    copied: torch.cuda.Event | None = None


class Feed(Protocol):
    """Batches in the order of a plan: what a training and an evaluation iterate over."""

    waited_s: float
    """Time that the consumer has spent waiting for data."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...

    def __iter__(self) -> Iterator[tuple[Draw, Batch]]: ...


class Prefetch(Iterator[tuple[Draw, Batch]]):
    """Hands out `(draw, batch)` for each draw of `plan`, in its order.

    The plan is consumed in the background thread, at most `buffers` draws ahead. On the CPU a
    batch stays as it is until the next one is asked for; on CUDA it is a copy on the device, made
    from pinned memory, that is never overwritten. An exception in the plan or in the store comes
    out of `next` at the batch it belongs to. Use as a context manager, or call `close`.
    """

    def __init__(
        self,
        store: FeatureStore,
        plan: Iterable[Draw],
        windows: Windows,
        device: torch.device,
        buffers: int = 2,
        lags: Lags = NO_LAGS,
    ) -> None:
        assert buffers >= 2, "one buffer in use, one being filled"
        self.waited_s = 0.0
        """Time that the consumer has spent waiting for data."""
        self._store = store
        self._windows = windows
        self._lags = lags
        self._device = device
        self._free: queue.SimpleQueue[_Buffer | None] = queue.SimpleQueue()
        self._filled: queue.SimpleQueue[tuple[Draw, _Buffer] | BaseException | None] = (
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

    def __next__(self) -> tuple[Draw, Batch]:
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
        draw, buffer = item
        self._in_use = buffer
        return draw, self._deliver(buffer)

    def close(self) -> None:
        """Stop the thread and wait for it; the last batch handed out stays valid."""
        self._ended = True
        self._closing.set()
        self._free.put(None)
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _deliver(self, buffer: _Buffer) -> Batch:
        assert buffer.batch is not None
        if self._device.type == "cpu":
            return buffer.batch
        delivered = buffer.batch.to(self._device, non_blocking=self._device.type == "cuda")
        if self._device.type == "cuda":
            buffer.copied = torch.cuda.Event()
            buffer.copied.record(torch.cuda.current_stream(self._device))
        return delivered

    def _release(self) -> None:
        if self._in_use is not None:
            self._free.put(self._in_use)
            self._in_use = None

    def _work(self, plan: Iterable[Draw]) -> None:
        try:
            for draw in plan:
                buffer = self._free.get()
                if buffer is None or self._closing.is_set():
                    return
                self._fill(buffer, draw)
                self._filled.put((draw, buffer))
            self._filled.put(None)
        except BaseException as error:  # it belongs to the thread that asks for the batch
            self._filled.put(error)

    def _fill(self, buffer: _Buffer, draw: Draw) -> None:
        if buffer.copied is not None:
            buffer.copied.synchronize()
        sizes = astuple(self._windows)
        if buffer.batch is None or len(buffer.batch) != len(draw.ticks):
            empty = self._store.empty_batch(len(draw.ticks), *sizes)
            buffer.batch = empty.pin() if self._device.type == "cuda" else empty
        self._store.gather(
            draw.ticks,
            *sizes,
            feature_lag=self._lags.features,
            sensor_lag_s=self._lags.sensor_s,
            state_lag_s=self._lags.state_s,
            variants=draw.variants,
            out=buffer.batch,
        )
