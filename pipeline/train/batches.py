"""The batches that a policy learns from: their ticks, and how they are gathered.

`Prefetch` gathers ahead of time into a few reused buffers: a fresh output for every batch costs
more in page faults than the gather itself, and a gather between two steps makes the device wait.
Training gets its batches from a `FeatureSource`.
"""

import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.base.config import TrainHeadParams
from pipeline.base.provenance import GoldenRow
from pipeline.policy.policy import Policy, Trainable
from pipeline.store import Batch, FeatureStore

Ticks = NDArray[np.int64]


@dataclass(frozen=True)
class Lags:
    """How late each stream is: `features` in whole VL rows, the others in seconds.

    Each is one number for all samples of a batch, or (batch,).
    """

    features: int | NDArray[np.int64] = 0
    sensor_s: float | NDArray[np.float64] = 0.0
    state_s: float | NDArray[np.float64] = 0.0


NO_LAGS = Lags()


@dataclass(frozen=True, eq=False)
class BatchIndices:
    """The ticks of a batch, and which variant and lag each sees."""

    ticks: Ticks
    """(batch,) store-global."""
    variants: NDArray[np.int64] | None = None
    """(batch,) the stored variant of the VL row of each tick; None: all 0, the plain frames."""
    lags: Lags = NO_LAGS


def cut_batches(ticks: Ticks, batch_size: int) -> list[BatchIndices]:
    """The ticks in their order, `batch_size` at a time."""
    return [
        BatchIndices(part) for part in np.split(ticks, range(batch_size, len(ticks), batch_size))
    ]


def evenly(ticks: Ticks, most: int) -> Ticks:
    """At most `most` of these ticks, evenly spaced."""
    return ticks[np.linspace(0, len(ticks) - 1, min(len(ticks), most)).round().astype(np.int64)]


@dataclass(frozen=True)
class Windows:
    """How much of each stream a sample sees: at most so many readings, none older than so long.

    `horizon` is the length of the action chunk in ticks. The windows count readings, or with `_s`
    seconds before the tick; None seconds allow any age. `FeatureStore.gather` has the same names.
    """

    horizon: int
    sensor_window: int
    state_window: int
    sensor_window_s: float | None = None
    state_window_s: float | None = None
    feature_history: int = 1
    """VL rows side by side in the slots, the newest first."""

    @classmethod
    def of(cls, params: TrainHeadParams) -> Self:
        """The windows that `params` set; a stream whose encoder is off gets a single reading."""
        return cls(
            params.horizon,
            params.sensor_window if params.sensor_enabled else 1,
            params.state_readings if params.robot_state_enabled else 1,
            params.sensor_reach_s,
            params.state_reach_s,
            params.feature_history if params.features_enabled else 1,
        )


@dataclass
class _Buffer:
    """A reused host batch, and its copy to the device, which must end before it is refilled."""

    batch: Batch | None = None
    copied: torch.cuda.Event | None = None


class Prefetch(Iterator[tuple[BatchIndices, Batch]], AbstractContextManager["Prefetch"]):
    """Yields `(indices, batch)` for each entry of `plan`, in its order.

    A background thread consumes the plan, at most `buffers` batches ahead. On the CPU a batch is
    valid until the next one is requested; on CUDA it is a copy on the device, made from pinned
    memory, that is never overwritten. `next` raises an exception of the plan or the store at the
    batch it belongs to. Use it as a context manager, or call `close`. The thread does not survive
    a fork: a forked process must make its own `Prefetch` on the same store. The store is read into
    memory in the background, as far as it fits.
    """

    def __init__(
        self,
        store: FeatureStore,
        plan: Iterable[BatchIndices],
        windows: Windows,
        device: torch.device,
        buffers: int = 2,
    ) -> None:
        assert buffers >= 2, "one buffer in use, one being filled"
        self.waited_s = 0.0
        """Time that the consumer has spent waiting for data."""
        self._store, self._device, self._windows = store, device, windows
        self._plan = self._warmed(plan)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="prefetch")
        self._coming: deque[tuple[_Buffer, Future[tuple[BatchIndices, Batch] | None]]] = deque()
        for _ in range(buffers):
            self._begin(_Buffer())
        self._in_use: _Buffer | None = None

    def __next__(self) -> tuple[BatchIndices, Batch]:
        if self._in_use is not None:
            self._begin(self._in_use)
        if not self._coming:
            raise StopIteration
        started = time.perf_counter()
        self._in_use, coming = self._coming.popleft()
        try:
            filled = coming.result()
        except BaseException:
            self.close()
            raise
        if filled is None:
            self.close()
            raise StopIteration
        indices, batch = filled
        if self._device.type == "cuda":
            batch = batch.to(self._device, non_blocking=True)
            self._in_use.copied = torch.cuda.Event()
            self._in_use.copied.record(torch.cuda.current_stream(self._device))
        self.waited_s += time.perf_counter() - started
        return indices, batch

    def close(self) -> None:
        """Stop the thread and wait for it; the last batch handed out stays valid."""
        self._in_use = None
        self._coming.clear()
        self._thread.shutdown(cancel_futures=True)

    def __exit__(self, *raised: object) -> None:
        self.close()

    def _warmed(self, plan: Iterable[BatchIndices]) -> Iterator[BatchIndices]:
        self._store.warm()
        yield from plan

    def _begin(self, buffer: _Buffer) -> None:
        self._coming.append((buffer, self._thread.submit(self._fill, buffer)))

    def _fill(self, buffer: _Buffer) -> tuple[BatchIndices, Batch] | None:
        """The next batch of the plan, on the host; None at the plan's end."""
        indices = next(self._plan, None)
        if indices is None:
            return None
        if buffer.copied is not None:
            buffer.copied.synchronize()
        count = len(indices.ticks)
        if buffer.batch is None or len(buffer.batch) != count:
            asked = self._windows
            empty = self._store.gatherer.empty_batch(
                count,
                asked.horizon,
                asked.sensor_window,
                asked.state_window,
                asked.feature_history,
            )
            buffer.batch = empty.pin() if self._device.type == "cuda" else empty.touch()
        return indices, self._store.gather(
            indices.ticks,
            **asdict(self._windows),
            feature_lag=indices.lags.features,
            sensor_lag_s=indices.lags.sensor_s,
            state_lag_s=indices.lags.state_s,
            variants=indices.variants,
            out=buffer.batch,
        )


class FeatureSource:
    """Features from the store; only the policy is trained and saved.

    A subclass puts a model before the policy.
    """

    identity: Mapping[str, Any] = {}
    """JSON of everything besides store and params that decides the run's numbers; may be empty."""
    eval_ticks: int | None = None
    """The most val ticks of an evaluation during training; None: the trainer's own limit."""

    def __init__(self, store: FeatureStore) -> None:
        self.store = store

    def summary(self) -> list[str]:
        """Lines for the user."""
        return []

    @property
    def golden(self) -> tuple[GoldenRow, ...]:
        """The store's golden rows: a live model is checked against their features.

        Raises `StoreIncomplete` where one is damaged.
        """
        return self.store.golden

    def attach(self, policy: Policy) -> Trainable:
        """The module that is trained; it holds the policy."""
        return policy

    def policy_of(self, module: Trainable) -> Policy:
        """The policy inside a module that `attach` returned, or inside a copy of it."""
        assert isinstance(module, Policy)
        return module

    def parameter_lr(self, name: str) -> float | None:
        """The peak learning rate of a parameter of the module; None: the rate of `train_head`."""
        return None

    def feed(
        self, plan: Iterable[BatchIndices], windows: Windows, device: torch.device
    ) -> Prefetch:
        """The batches of a plan, in its order, in the form that the module takes."""
        return Prefetch(self.store, plan, windows, device)

    def save(self, folder: Path, module: Trainable) -> None:
        """Write further files beside the policy's in a checkpoint folder; here there are none."""
