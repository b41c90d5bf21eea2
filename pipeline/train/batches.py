"""The batches that a policy learns from: their ticks, where they are gathered, and by whom.

`Prefetch` gathers ahead of time into a few reused buffers: a fresh output for every batch costs
more in page faults than the gather itself, and a gather between two steps makes the device wait.
`DeviceStore` holds streams on the device and gathers there; `choose_feed` chooses which. Training
gets its batches from a `FeatureSource`.
"""

import time
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Shaped
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from pipeline.base.config import TrainHeadParams
from pipeline.base.machine import available_bytes
from pipeline.base.source import GoldenRow
from pipeline.base.text import size
from pipeline.policy.policy import Policy, Trainable
from pipeline.store import Batch, FeatureStore
from pipeline.store.gather import WIDE, Index, Late, Selection, Window
from pipeline.store.mapping import fitting

Ticks = NDArray[np.int64]
_DEVICE_SHARE = 0.6
"""The share of the device's free memory that a store may fill; the rest is for the training."""


@dataclass(frozen=True)
class Lags:
    """How late each stream is: `features` in whole VL rows, the others in seconds.

    Each is one number for all samples of a batch, or (batch,).
    """

    features: Late = 0
    sensor_s: Late = 0.0
    state_s: Late = 0.0


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


class DeviceStore:
    """A copy on a device of the arrays of a store's wide fields (`pipeline.store.gather.WIDE`).

    They are copied once, with a progress bar. For each batch the host computes the rows and sends
    only a few small index tensors.
    """

    def __init__(self, store: FeatureStore, fields: Collection[str], device: torch.device) -> None:
        sources = {name: store.gatherer.tensor(name) for name in sorted(fields)}
        sources = {name: source for name, source in sources.items() if source.nbytes}
        self.fields = frozenset(sources)
        """The fields on the device, without those of streams that the store lacks."""
        self._device = device
        bar = tqdm(sources.items(), f"store to {device}", unit="stream", disable=None)
        self._tensors = {name: source.to(device, copy=True) for name, source in bar}

    def complete(self, batch: Batch, selection: Selection) -> Batch:
        """The batch with this store's fields gathered on the device; other fields do not move.

        On CUDA it returns without waiting: the work is queued on the current stream.
        """
        gathered: dict[str, Tensor] = {}
        for name in self.fields & selection.rows.keys():
            shape = getattr(batch, name).shape
            index = self._send(selection.rows[name])
            gathered[name] = self._tensors[name].index_select(0, index).view(shape)
        for name in self.fields & selection.windows.keys():
            length = getattr(batch, name).shape[1]
            gathered[name] = self._window(self._tensors[name], selection.windows[name], length)
        return replace(batch, **gathered)

    def _window(
        self, readings: Shaped[Tensor, "reading channel"], window: Window, length: int
    ) -> Shaped[Tensor, "batch window channel"]:
        """The windows of a batch, with zeros before the first real reading."""
        place = torch.arange(length, device=self._device)
        rows = (self._send(window.end)[:, None] + place - length).clamp_(min=0)
        values = readings.index_select(0, rows.view(-1)).view(*rows.shape, -1)
        if len(rows) and int(window.valid.min()) < length:
            before = place < length - self._send(window.valid)[:, None]
            values.masked_fill_(before[..., None], 0)
        return values

    def _send(self, index: Index) -> Tensor:
        host = torch.from_numpy(index)
        if self._device.type == "cuda":
            host = host.pin_memory()
        return host.to(self._device, non_blocking=True)


def choose_feed(
    feed: str, store: FeatureStore, device: torch.device, free: int | None = None
) -> tuple[frozenset[str], str]:
    """Which wide fields of a batch to keep on the device, and a line that says why.

    With `feed` "device" these are the streams that fit into a share of its `free` bytes (measured
    if None), the smallest first; with "auto" all of them if it is a GPU and all fit, else none.
    """
    chosen_by = "auto" if feed == "auto" else "as train_head.feed says"
    if feed == "mapped":
        return frozenset(), f"feed: mapped ({chosen_by})"
    if feed == "auto" and device.type != "cuda":
        return frozenset(), f"feed: mapped (auto: training runs on the {device})"
    if free is None:
        on_gpu = device.type == "cuda"
        free = torch.cuda.mem_get_info(device)[0] if on_gpu else available_bytes()
    sizes = {name: store.gatherer.tensor(name).nbytes for name in WIDE}
    wide = {name: count for name, count in sizes.items() if count}
    fields = fitting(wide, free, _DEVICE_SHARE)
    room = (
        f"{_DEVICE_SHARE:.0%} of the {size(free)} free on {device} hold "
        f"{', '.join(fields) or 'nothing'} of {', '.join(wide)}"
    )
    if feed == "auto" and len(fields) < len(wide):
        return frozenset(), f"feed: mapped (auto: {room})"
    return frozenset(fields), f"feed: device ({chosen_by}; {room})"


_Filled = tuple[BatchIndices, Batch, Selection]


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
    a fork: a forked process must make its own `Prefetch` on the same store.

    The fields of `resident` are gathered on its device, into fresh memory; on CUDA this happens
    when the batch is handed out, on the consumer's stream. The rest of the store is read into
    memory in the background, as far as it fits.
    """

    def __init__(
        self,
        store: FeatureStore,
        plan: Iterable[BatchIndices],
        windows: Windows,
        device: torch.device,
        buffers: int = 2,
        resident: DeviceStore | None = None,
    ) -> None:
        assert buffers >= 2, "one buffer in use, one being filled"
        self.waited_s = 0.0
        """Time that the consumer has spent waiting for data."""
        self._store, self._device, self._resident = store, device, resident
        self._windows = astuple(windows)
        self._on_device = frozenset[str]() if resident is None else resident.fields
        self._plan = self._warmed(plan)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="prefetch")
        self._coming: deque[tuple[_Buffer, Future[_Filled | None]]] = deque()
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
        indices, batch, selection = filled
        if self._device.type == "cuda":
            batch = self._complete(batch, selection).to(self._device, non_blocking=True)
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
        self._store.warm(but=self._on_device)
        yield from plan

    def _begin(self, buffer: _Buffer) -> None:
        self._coming.append((buffer, self._thread.submit(self._fill, buffer)))

    def _fill(self, buffer: _Buffer) -> _Filled | None:
        """The next batch of the plan, without the fields on a GPU; None at the plan's end."""
        indices = next(self._plan, None)
        if indices is None:
            return None
        if buffer.copied is not None:
            buffer.copied.synchronize()
        count = len(indices.ticks)
        if buffer.batch is None or len(buffer.batch) != count:
            empty = self._store.gatherer.empty_batch(
                count, *self._windows[:3], feature_history=self._windows[5], but=self._on_device
            )
            buffer.batch = empty.pin() if self._device.type == "cuda" else empty.touch()
        late = indices.lags
        lags = (late.features, late.sensor_s, late.state_s)
        batch, selection = self._store.select(
            indices.ticks, self._windows, lags, buffer.batch, indices.variants
        )
        self._store.gatherer.copy(selection, batch, but=self._on_device)
        if self._device.type != "cuda":
            batch = self._complete(batch, selection)
        return indices, batch, selection

    def _complete(self, batch: Batch, selection: Selection) -> Batch:
        return batch if self._resident is None else self._resident.complete(batch, selection)


class FeatureSource:
    """Features from the store; only the policy is trained and saved.

    A subclass puts a model before the policy. The wide fields that `on_device` names are kept on
    the device; the first feed copies them there, once for all feeds.
    """

    identity: Mapping[str, Any] = {}
    """JSON of everything besides store and params that decides the run's numbers; may be empty."""
    eval_ticks: int | None = None
    """The most val ticks of an evaluation during training; None: the trainer's own limit."""

    def __init__(self, store: FeatureStore, on_device: Collection[str] = (), *notes: str) -> None:
        self.store = store
        self.notes = notes
        """Lines for the user."""
        self._on_device = on_device
        self._resident: DeviceStore | None = None

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
        if self._on_device and self._resident is None:
            self._resident = DeviceStore(self.store, self._on_device, device)
        return Prefetch(self.store, plan, windows, device, resident=self._resident)

    def save(self, folder: Path, module: Trainable) -> None:
        """Write further files beside the policy's in a checkpoint folder; here there are none."""
