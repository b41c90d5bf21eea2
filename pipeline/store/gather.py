"""Gather windows and rows out of flat maps into reused buffers.

Everything is an index computation followed by one `index_select` into the buffer, which runs at the
speed of a row gather in C; no sample is touched from Python.
"""

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.store.batch import Batch


class Gatherer:
    """Fills batches from the arrays of one store, given by name.

    Each VL row holds its slots once a variant, variant after variant.
    """

    def __init__(self, arrays: Mapping[str, NDArray[Any]], variants: int) -> None:
        self._arrays = arrays
        self._variants = variants
        self._tensors: dict[str, Tensor] = {}

    def gather(
        self,
        batch: Batch,
        tick: NDArray[np.int64],
        feature_lag: int,
        sensor_lag_s: float,
        state_lag_s: float,
        variant: NDArray[np.int64] | None,
    ) -> None:
        """Fill `batch` with what belongs to these ticks; see `FeatureStore.gather`."""
        episode = np.searchsorted(self._arrays["episode/tick_start"], tick, side="right") - 1
        self._features(batch, tick, episode, feature_lag, variant)
        for stream, window, counts, lag_s in (
            ("sensor", batch.sensor, batch.sensor_valid, sensor_lag_s),
            ("state", batch.state, batch.state_valid, state_lag_s),
        ):
            first = self._arrays[f"episode/{stream}_start"][episode]
            end = self._window_ends(stream, tick, first, lag_s)
            self._window(f"{stream}/values", window, counts, first, end)
        self._action(batch, tick, episode)

    def empty_batch(self, batch: int, horizon: int, sensor_window: int, state_window: int) -> Batch:
        """Buffers for `gather(..., out=)`."""
        _, slots, dim = self._tensor("vl/features").shape
        action = (batch, horizon, self._arrays["tick/action"].shape[1])
        return Batch(
            features=torch.empty((batch, slots, dim), dtype=self._tensor("vl/features").dtype),
            slot_valid=torch.empty((batch, slots), dtype=torch.bool),
            feature_age=torch.empty(batch),
            sensor=torch.empty(
                (batch, sensor_window, self._arrays["sensor/values"].shape[1]),
                dtype=self._tensor("sensor/values").dtype,
            ),
            sensor_valid=torch.empty(batch, dtype=torch.int64),
            state=torch.empty((batch, state_window, self._arrays["state/values"].shape[1])),
            state_valid=torch.empty(batch, dtype=torch.int64),
            action=torch.empty(action),
            action_valid=torch.empty(action[:2], dtype=torch.bool),
        )

    def _features(
        self,
        batch: Batch,
        tick: NDArray[np.int64],
        episode: NDArray[np.int64],
        lag: int,
        variant: NDArray[np.int64] | None,
    ) -> None:
        row = self._arrays["tick/vl_row"][tick]
        if lag:
            row = np.maximum(row - lag, self._arrays["episode/vl_start"][episode])
        view = row * self._variants + (0 if variant is None else variant)
        index = torch.from_numpy(view)
        torch.index_select(self._tensor("vl/features"), 0, index, out=batch.features)
        batch.slot_valid.copy_(self._tensor("vl/slot_valid").index_select(0, index))
        age = self._arrays["tick/time"][tick] - self._newest_frame[row]
        batch.feature_age.copy_(torch.from_numpy(age))

    @cached_property
    def _newest_frame(self) -> NDArray[np.float64]:
        """Capture time of each VL row's newest frame; its tick where it has no frame at all."""
        frames = self._arrays["vl/frame_time"]
        shown = np.isfinite(frames)
        newest = np.max(frames, axis=1, where=shown, initial=-np.inf)
        return np.where(shown.any(axis=1), newest, self._arrays["vl/time"])

    def _window_ends(
        self, stream: str, tick: NDArray[np.int64], first: NDArray[np.int64], lag_s: float
    ) -> NDArray[np.int64]:
        end = self._arrays[f"tick/{stream}_end"][tick]
        if not lag_s:
            return end
        clock = self._arrays[f"{stream}/time"]
        until = self._arrays["tick/time"][tick] - lag_s
        return np.array(
            [
                start + np.searchsorted(clock[start:stop], instant, side="right")
                for start, stop, instant in zip(first, end, until, strict=True)
            ],
            np.int64,
        )

    def _window(
        self,
        name: str,
        out: Tensor,
        counts: Tensor,
        first: NDArray[np.int64],
        end: NDArray[np.int64],
    ) -> None:
        window = out.shape[1]
        real = np.minimum(end - first, window)
        counts.copy_(torch.from_numpy(real))
        if not out.numel():
            return
        index = end[:, None] - np.arange(window, 0, -1)
        before = index < first[:, None]
        readings = self._tensor(name)
        inside = np.where(before, 0, index)
        flat = out.view(-1, out.shape[2])
        torch.index_select(readings, 0, torch.from_numpy(inside.ravel()), out=flat)
        if before.any():
            flat[torch.from_numpy(before.ravel())] = 0

    def _action(self, batch: Batch, tick: NDArray[np.int64], episode: NDArray[np.int64]) -> None:
        horizon = batch.action.shape[1]
        stop = self._arrays["episode/tick_start"][episode + 1]
        index = tick[:, None] + np.arange(horizon)
        batch.action_valid.copy_(torch.from_numpy(index < stop[:, None]))
        kept = torch.from_numpy(np.minimum(index, stop[:, None] - 1).ravel())
        flat = batch.action.view(-1, batch.action.shape[2])
        torch.index_select(self._tensor("tick/action"), 0, kept, out=flat)

    def _tensor(self, name: str) -> Tensor:
        """An array as it is gathered from: those of the slots as (vl_row x variant, slot, …)."""
        if name not in self._tensors:
            tensor = torch.from_numpy(self._arrays[name])
            if name == "vl/features" and self._arrays[name].dtype == np.uint16:
                tensor = tensor.view(torch.bfloat16)
            if name in ("vl/features", "vl/slot_valid"):
                rows, slots, *rest = tensor.shape
                tensor = tensor.view(rows * self._variants, slots // self._variants, *rest)
            self._tensors[name] = tensor
        return self._tensors[name]
