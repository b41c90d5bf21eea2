"""Gather windows and rows from flat maps into reused buffers.

Indices are computed for whole batches; then one `index_select` per stream fills its buffer at the
speed of a row gather in C. No Python code runs per sample.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from pipeline.base.hardware import available_bytes
from pipeline.base.observation import Observation
from pipeline.base.provenance import CLOCK_SLACK_S
from pipeline.store.episodes import episode_of
from pipeline.store.memory_map import fitting, populate, read_at_random, will_need

WIDE = {
    "action": "tick/action",
    "features": "vl/features",
    "state": "state/values",
    "sensor": "sensor/values",
}
"""The fields of a batch that are copied row by row from an array, and that array's name."""
_BLOCK_ELEMENTS = 32768
"""Most elements of a block of readings that is copied at once. With larger blocks torch splits each
block over its threads, instead of giving each thread its own blocks, and is slower."""
_CACHE_LINE = 64

Index = NDArray[np.int64]
Late = int | float | NDArray[Any]
"""How late a stream is: one number for all samples of a batch, or (batch,)."""


@dataclass
class Batch(Observation):
    """What a policy sees at `batch` ticks, and the actions that it should answer.

    A stream that the store lacks has width 0. Features and sensor keep their stored dtype.
    """

    action: Float[Tensor, "batch horizon action_dim"]
    action_valid: Bool[Tensor, "batch horizon"]

    def __len__(self) -> int:
        return len(self.features)

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """(batch, horizon, sensor_window, state_window)."""
        return len(self), self.action.shape[1], self.sensor.shape[1], self.state.shape[1]

    def to(self, device: torch.device | str, non_blocking: bool = False) -> Self:
        """The batch on another device; fields that are not tensors stay as they are."""
        return self._mapped(lambda tensor: tensor.to(device, non_blocking=non_blocking))

    def pin(self) -> Self:
        """The batch in page-locked memory, from which copies to a GPU are asynchronous."""
        return self._mapped(lambda tensor: tensor.pin_memory())

    def touch(self) -> Self:
        """Zero the batch in place, so that every page of its memory exists before it is filled."""
        return self._mapped(lambda tensor: tensor.zero_())

    def _mapped(self, change: Callable[[Tensor], Tensor]) -> Self:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        tensors = {name: value for name, value in values.items() if isinstance(value, Tensor)}
        return replace(self, **{name: change(value) for name, value in tensors.items()})


@dataclass(frozen=True, eq=False)
class Window:
    """Which readings each sample of a batch sees: the last `valid` (batch,) readings before index
    `end` (batch,), right-aligned in a window of at least that length."""

    end: Index
    valid: Index


@dataclass(frozen=True, eq=False)
class Selection:
    """Where the wide fields of a batch lie in the tensors of `Gatherer.tensor`."""

    rows: Mapping[str, Index]
    """`features` (batch x row,) and `action` (batch x horizon,)."""
    windows: Mapping[str, Window]
    """`sensor` and `state`."""


class Gatherer:
    """Fills batches from the arrays of one store, given by name.

    Each VL row holds its slots once per variant, one variant after the other.
    """

    def __init__(self, arrays: Mapping[str, NDArray[Any]], variants: int) -> None:
        self._arrays = arrays
        self._variants = variants
        self._tensors: dict[str, Tensor] = {}
        wide = {name: arrays[array] for name, array in WIDE.items()}
        self.in_memory = fitting({name: a.nbytes for name, a in wide.items()}, available_bytes())
        """The wide fields whose arrays fit in memory together, smallest first."""
        for name in wide.keys() - {*self.in_memory}:
            read_at_random(wide[name])

    def select(
        self,
        batch: Batch,
        tick: Index,
        feature_lag: Late,
        sensor_lag_s: Late,
        state_lag_s: Late,
        variant: Index | None,
        oldest_s: Mapping[str, float | None],
    ) -> Selection:
        """Fill the fields of `batch` that are not wide; return where the wide ones lie.

        `oldest_s` says how many seconds the windows of `sensor` and `state` reach back. See
        `FeatureStore.gather`.
        """
        episode = episode_of(self._arrays, tick)
        return Selection(
            {
                "features": self._features(batch, tick, episode, feature_lag, variant),
                "action": self._action(batch, tick, episode),
            },
            {
                stream: self._window(stream, batch, tick, episode, lag_s, oldest_s[stream])
                for stream, lag_s in (("sensor", sensor_lag_s), ("state", state_lag_s))
            },
        )

    def copy(self, selection: Selection, batch: Batch) -> None:
        """Fill the wide fields of `batch` that the selection names."""
        for name, rows in selection.rows.items():
            self._expect(name, rows, 1)
            out: Tensor = getattr(batch, name)
            flat = out.view(len(rows), *self.tensor(name).shape[1:])
            torch.index_select(self.tensor(name), 0, torch.from_numpy(rows), out=flat)
        for name, window in selection.windows.items():
            out = getattr(batch, name)
            if out.numel():
                self._expect(name, window.end - out.shape[1], out.shape[1])
                copy_windows(self.tensor(name), window, out)

    def empty_batch(
        self,
        batch: int,
        horizon: int,
        sensor_window: int,
        state_window: int,
        feature_history: int = 1,
    ) -> Batch:
        """Buffers for `gather(..., out=)`."""

        def wide(name: str, *shape: int) -> Tensor:
            like = self.tensor(name)
            return _buffer((*shape, *like.shape[1:]), like.dtype)

        features = wide("features", batch, feature_history).flatten(1, 2)
        return Batch(
            features=features,
            slot_valid=torch.empty(features.shape[:2], dtype=torch.bool),
            feature_age=torch.empty(batch),
            view_age=torch.empty(batch, self._arrays["vl/frame_time"].shape[1]),
            sensor=wide("sensor", batch, sensor_window),
            sensor_valid=torch.empty(batch, dtype=torch.int64),
            sensor_age=torch.empty(batch, sensor_window),
            state=wide("state", batch, state_window),
            state_valid=torch.empty(batch, dtype=torch.int64),
            state_age=torch.empty(batch, state_window),
            action=wide("action", batch, horizon),
            action_valid=torch.empty((batch, horizon), dtype=torch.bool),
        )

    def tensor(self, name: str) -> Tensor:
        """The map of a wide field; for the features, (vl_row x variant, slot, dim)."""
        if name not in self._tensors:
            array = self._arrays[WIDE[name]]
            tensor = torch.from_numpy(array)
            if name == "features":
                tensor = tensor.view(torch.bfloat16) if array.dtype == np.uint16 else tensor
                tensor = tensor.view(*self._by_variant(array))
            self._tensors[name] = tensor
        return self._tensors[name]

    def feature_age(self, tick: Index, row: Index) -> NDArray[np.float64]:
        """(tick,) seconds since the newest frame of each tick's VL row, or since the row's own tick
        if it has no frame."""
        frame_times = self._arrays["vl/frame_time"][row]
        newest = np.fmax.reduce(frame_times, axis=1, initial=-np.inf)
        newest = np.where(np.isfinite(newest), newest, self._arrays["vl/time"][row])
        return self._arrays["tick/time"][tick] - newest

    def vl_rows(self, tick: Index, episode: Index, lag: Late = 0) -> Index:
        """(tick,) the VL row of each tick, `lag` rows back, but not before the episode's first."""
        row = self._arrays["tick/vl_row"][tick]
        return np.maximum(row - lag, self._arrays["episode/vl_start"][episode])

    def populate(self) -> None:
        """Read the wide fields that fit in memory, one by one."""
        for name in self.in_memory:
            populate(self._arrays[WIDE[name]])

    def _by_variant(self, array: NDArray[Any]) -> tuple[int, ...]:
        rows, slots, *rest = array.shape
        return rows * self._variants, slots // self._variants, *rest

    def _features(
        self, batch: Batch, tick: Index, episode: Index, lag: Late, variant: Index | None
    ) -> Index:
        row = self.vl_rows(tick, episode, lag)
        valid = self._arrays["vl/slot_valid"]
        valid = valid.reshape(self._by_variant(valid))
        history = batch.features.shape[1] // max(1, valid.shape[1])
        first = self._arrays["episode/vl_start"][episode][:, None]
        rows = np.maximum(row[:, None] - np.arange(max(1, history)), first)
        view = rows if self._variants == 1 else rows * self._variants
        view = (view if variant is None else view + variant[:, None]).ravel()
        there = batch.slot_valid.numpy().reshape(len(view), valid.shape[1])
        np.not_equal(valid[view], 0, out=there)
        batch.feature_age.numpy()[:] = self.feature_age(tick, row)
        now = self._arrays["tick/time"][tick][:, None]
        batch.view_age.numpy()[:] = now - self._arrays["vl/frame_time"][row]
        return view

    def _window(
        self,
        stream: str,
        batch: Batch,
        tick: Index,
        episode: Index,
        lag_s: Late,
        oldest_s: float | None,
    ) -> Window:
        first = self._arrays[f"episode/{stream}_start"][episode]
        end = self._arrays[f"tick/{stream}_end"][tick]
        now, clock = self._arrays["tick/time"][tick], self._arrays[f"{stream}/time"]
        if np.any(lag_s):
            late = _first_after(clock, first, end, now - lag_s)
            end = np.where(np.equal(lag_s, 0), end, late)
        window, counts = getattr(batch, stream).shape[1], getattr(batch, f"{stream}_valid").numpy()
        valid = np.minimum(end - first, window, out=counts)
        ages = getattr(batch, f"{stream}_age").numpy()
        if not len(clock):
            ages[:] = 0
            return Window(end, valid)
        steps = np.arange(-window, 0)
        age_s = now[:, None] - clock[np.maximum(end[:, None] + steps, 0)]
        real = steps >= -valid[:, None]
        if oldest_s is not None:
            real &= age_s <= oldest_s + CLOCK_SLACK_S
            np.sum(real, axis=1, out=valid)
        np.multiply(age_s, real, out=ages, casting="same_kind")
        return Window(end, valid)

    def _action(self, batch: Batch, tick: Index, episode: Index) -> Index:
        horizon = batch.action.shape[1]
        stop = self._arrays["episode/tick_start"][episode + 1][:, None]
        index = tick[:, None] + np.arange(horizon)
        np.less(index, stop, out=batch.action_valid.numpy())
        return np.minimum(index, stop - 1).ravel()

    def _expect(self, name: str, first: Index, rows: int) -> None:
        """Start to read these rows from the disk if their map does not fit in memory."""
        if name not in self.in_memory:
            variants = self._variants if name == "features" else 1
            will_need(self._arrays[WIDE[name]], first // variants, rows)


def copy_windows(readings: Tensor, window: Window, out: Tensor) -> None:
    """Fill `out` (batch, window, channel) from `readings` (reading, channel), zeros on the left."""
    batch, length, channels = out.shape
    if len(window.end) and len(readings) and window.end.min() >= length:
        # Overlapping blocks, one per first reading, so that there are few, long copies.
        block = _block(length, channels)
        blocks = readings.as_strided((len(readings) - block + 1, block * channels), (channels, 1))
        index = window.end[:, None] + np.arange(-length, 0, block)
        flat = out.view(-1, block * channels)
        torch.index_select(blocks, 0, torch.from_numpy(index.ravel()), out=flat)
    elif len(readings):
        index = np.maximum(window.end[:, None] + np.arange(-length, 0), 0)
        flat = out.view(-1, channels)
        torch.index_select(readings, 0, torch.from_numpy(index.ravel()), out=flat)
    if len(window.valid) and window.valid.min() < length:
        padding = np.flatnonzero(np.arange(length) < length - window.valid[:, None])
        out.view(batch * length, channels).index_fill_(0, torch.from_numpy(padding), 0)


def _block(length: int, channels: int) -> int:
    """Readings per copy: the most that divide a window of `length` and are few enough."""
    most = max(1, _BLOCK_ELEMENTS // channels)
    return next(size for size in range(min(length, most), 0, -1) if length % size == 0)


def _first_after(
    clock: NDArray[np.float64], low: Index, high: Index, instant: NDArray[np.float64]
) -> Index:
    """For each sample, the first reading in low..high - 1 later than its instant, else `high`.

    Bisects all samples at once: the clock ascends only within each sample's own range.
    """
    while (searching := low < high).any():
        middle = (low + high) // 2
        reached = clock[np.where(searching, middle, 0)] <= instant
        low = np.where(searching & reached, middle + 1, low)
        high = np.where(searching & ~reached, middle, high)
    return low


def _buffer(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """Uninitialised memory from numpy, which, unlike torch, asks the kernel for huge pages."""
    size = int(np.prod(shape)) * dtype.itemsize
    raw = np.empty(size + _CACHE_LINE, np.uint8)
    begin = -raw.ctypes.data % _CACHE_LINE
    return torch.from_numpy(raw[begin : begin + size]).view(dtype).view(shape)
