"""Open a finished store and gather batches from it at memory speed.

torch is imported with the first batch, not before, because to inspect a store needs no torch.
"""

import os
import sys
import threading
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.arrays import dim_of, widen
from pipeline.base.provenance import GoldenRow
from pipeline.store.chunks import check_seal
from pipeline.store.episodes import Episode, check_index, check_positions, episode_of, read_episodes
from pipeline.store.golden_rows import GoldenFrames, read_golden
from pipeline.store.memory_map import map_flat
from pipeline.store.paths import read_attributes
from pipeline.store.schema import (
    FEATURES,
    KEYS,
    POSITIONS,
    STREAMS,
    ArraySpec,
    check_agreement,
    chunk_paths,
    read_specs,
    rows_of,
)

if TYPE_CHECKING:
    from pipeline.store.gather import Batch, Gatherer


def _one_thread() -> None:
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


# OpenMP's threads do not survive a fork, and a forked process would wait for them for ever.
os.register_at_fork(after_in_child=_one_thread)


class FeatureStore:
    """A finished store, mapped read-only; opening costs milliseconds whatever its size.

    Survives `fork`; pickling reopens it, so that it can be sent to spawned workers.
    """

    def __init__(self, path: Path, attrs: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]):
        self.path = path
        self.attrs = attrs
        self._arrays = arrays
        self._warmed = False

    @classmethod
    def open(cls, path: str | Path) -> "FeatureStore":
        """Map a store.

        Raises `StoreIncomplete` when it is missing, unfinished or damaged, `StoreMismatch` when it
        has another schema.
        """
        root = Path(path)
        attributes, specs = read_attributes(root), read_specs(root)
        check_agreement(root, attributes, specs)
        check_seal(root, attributes.seal, specs)
        arrays = {name: map_array(root, spec) for name, spec in specs.items()}
        check_index(root, arrays, rows_of(specs))
        return cls(root, attributes.raw, arrays)

    def __reduce__(self) -> tuple[Any, ...]:
        return FeatureStore.open, (self.path,)

    def array(self, name: str) -> NDArray[Any]:
        """An array of the store by name, mapped; writes into it never reach the file.

        Raises `StoreIncomplete` for an array of positions in which a tick points outside its
        episode.
        """
        return (self._sound_arrays if name in POSITIONS else self._arrays)[name]

    @cached_property
    def _sound_arrays(self) -> Mapping[str, NDArray[Any]]:
        """The arrays, after a check of the ticks' positions, which reads all of them."""
        check_positions(self.path, self._arrays)
        return self._arrays

    @property
    def spec(self) -> dict[str, Any]:
        """The feature spec: the complete document with its digest."""
        return dict(self.attrs["feature_spec"])

    @property
    def streams(self) -> dict[str, Any]:
        """Names and units of each stream's channels; no names where the store lacks the stream."""
        return dict(self.attrs["streams"])

    @property
    def sources(self) -> list[str]:
        """Names of the sources, in the order of `episode/source`."""
        return list(self.attrs["sources"])

    @property
    def action_hz(self) -> float | None:
        """Ticks per second; None in older stores of recorded rows, which do not record it."""
        return self.attrs["action_hz"]

    @property
    def vlm_reuse_count(self) -> int:
        """Ticks that share one VL row."""
        return int(self.attrs["vlm_reuse_count"])

    @property
    def ticks(self) -> int:
        """Number of ticks."""
        return len(self._arrays["tick/time"])

    @property
    def variants(self) -> int:
        """Stored views of each VL row: 0 is the frames as they are, the others are augmented."""
        return int(self.attrs["feature_spec"].get("variants", 1))

    @property
    def feature_shape(self) -> tuple[int, int]:
        """(slot, dim) of one variant of a VL row."""
        features = self._arrays[FEATURES]
        return features.shape[1] // self.variants, dim_of(features)

    @property
    def action_dim(self) -> int:
        """Channels of an action."""
        return int(self._arrays["tick/action"].shape[1])

    @property
    def sensor_channels(self) -> int:
        """Channels of the sensor, 0 where the store has none."""
        return int(self._arrays["sensor/values"].shape[1])

    @property
    def state_dim(self) -> int:
        """Channels of the robot state, 0 where the store has none."""
        return int(self._arrays["state/values"].shape[1])

    @cached_property
    def golden(self) -> tuple[GoldenRow, ...]:
        """The golden rows with their features; empty where an earlier version wrote the store.

        Raises `StoreIncomplete` where the frames of a golden row do not give its key.
        """
        proven = read_golden(self.path, self._arrays[KEYS])
        return tuple(self._golden_row(frames) for frames in proven)

    def _golden_row(self, golden: GoldenFrames) -> GoldenRow:
        row, slots = golden.row, self.feature_shape[0]
        episode = next(episode for episode in self.episodes if row in episode.vl_rows)
        return GoldenRow(
            key=self._arrays[KEYS][row].tobytes(),
            instruction=episode.instruction,
            prompt=golden.prompt,
            frames=golden.frames,
            features=widen(self._arrays[FEATURES][row, :slots]).astype(np.float32),
            slot_valid=self._arrays["vl/slot_valid"][row, :slots].astype(np.bool_),
        )

    @cached_property
    def episodes(self) -> tuple[Episode, ...]:
        """All episodes, in order."""
        return read_episodes(self.path, self._arrays, self.sources)

    def episode_of(self, ticks: NDArray[np.int64]) -> NDArray[np.int64]:
        """The index of the episode of each of these store-global ticks."""
        return episode_of(self._arrays, ticks)

    def tick_step(self) -> float:
        """The median time in s from a tick to the next in its episode; NaN without such ticks."""
        steps = np.diff(self._arrays["tick/time"])
        steps = steps[np.diff(self.episode_of(np.arange(self.ticks))) == 0]
        return float(np.median(steps)) if len(steps) else float("nan")

    def feature_age(self, ticks: NDArray[np.int64]) -> NDArray[np.float64]:
        """(tick,) s from the newest frame behind each tick's features to the tick."""
        return self.gatherer.feature_age(ticks, self.array("tick/vl_row")[ticks])

    def gather(
        self,
        ticks: Sequence[int] | NDArray[np.int64],
        horizon: int = 8,
        sensor_window: int = 65,
        state_window: int = 100,
        feature_lag: "int | NDArray[np.int64]" = 0,
        sensor_lag_s: "float | NDArray[np.float64]" = 0.0,
        state_lag_s: "float | NDArray[np.float64]" = 0.0,
        out: "Batch | None" = None,
        variants: NDArray[np.int64] | None = None,
        sensor_window_s: float | None = None,
        state_window_s: float | None = None,
        feature_history: int = 1,
    ) -> "Batch":
        """The batch of these ticks (store-global), in the buffers of `out` if given.

        A window ends at the last reading at or before the tick minus the lag. It holds at most
        `sensor_window` or `state_window` readings, and none that is more than `sensor_window_s` or
        `state_window_s` older than the tick. `feature_lag` goes back whole VL rows, but not before
        the episode's first. A lag is one number for all ticks, or (batch,). Ages are measured at
        the tick. The action chunk begins at its own tick; after the episode's end it repeats the
        last action, marked invalid. `variants` (batch,) is the variant of the VL row for each tick;
        by default 0, the plain frames. `feature_history` VL rows are side by side in the slots, the
        newest first; the episode's first stands for those before it.

        Raises `IndexError` for a tick that the store does not have, and `ValueError` for a variant
        that it does not have, an `out` of other sizes, or a negative lag, which would show the
        future.
        """
        lags = (feature_lag, sensor_lag_s, state_lag_s)
        if any(np.min(lag, initial=0) < 0 for lag in lags):
            raise ValueError(f"a lag goes back in time and cannot be negative, found {lags}")
        tick = np.asarray(ticks, np.int64)
        if tick.size and (tick.min() < 0 or tick.max() >= self.ticks):
            raise IndexError(f"{self.path}: ticks lie in 0..{self.ticks - 1}, asked for {tick}")
        if variants is not None and (
            variants.shape != tick.shape
            or (tick.size and not 0 <= variants.min() <= variants.max() < self.variants)
        ):
            raise ValueError(
                f"{self.path}: expected a variant in 0..{self.variants - 1} for each of "
                f"{len(tick)} ticks, asked for {variants}. A store holds `vlm.variants` of them."
            )
        sizes = (len(tick), horizon, sensor_window, state_window)
        batch = self.gatherer.empty_batch(*sizes, feature_history) if out is None else out
        slots = self.feature_shape[0] * feature_history
        if batch.sizes != sizes or batch.features.shape[1] != slots:
            raise ValueError(
                "`out` has (batch, horizon, sensor_window, state_window) and slots "
                f"{batch.sizes}, {batch.features.shape[1]}, asked for {sizes}, {slots}"
            )
        oldest_s = {"sensor": sensor_window_s, "state": state_window_s}
        self.gatherer.copy(self.gatherer.select(batch, tick, *lags, variants, oldest_s), batch)
        return batch

    def warm(self) -> None:
        """Begin to read the fields that fit in memory, once, in the background.

        The reading thread ends with the process, and a forked process has none: page faults read
        the rest.
        """
        if not self._warmed:
            self._warmed = True
            read = self.gatherer.populate
            threading.Thread(target=read, name="warm", daemon=True).start()

    @cached_property
    def gatherer(self) -> "Gatherer":
        """Fills batches: it has their buffers, the maps and the second half of `gather`."""
        from pipeline.store.gather import Gatherer

        return Gatherer(self._sound_arrays, self.variants)


def episode_name(episode: Episode) -> str:
    """`source/id`, the name of an episode in checkpoints, reports and errors."""
    return f"{episode.source}/{episode.id}"


def place(store: FeatureStore, stream: str, row: int) -> str:
    """Where a store-global row of a stream lies: episode, row in the episode and its time."""
    starts = store.array(f"episode/{stream}_start")
    index = int(starts.searchsorted(row, side="right")) - 1
    time_s = float(store.array(f"{stream}/time")[row])
    return (
        f"{episode_name(store.episodes[index])}, {STREAMS[stream].row} "
        f"{row - int(starts[index])} (at {time_s:.3f} s)"
    )


def map_array(root: Path, spec: ArraySpec) -> NDArray[Any]:
    """Map an array whose chunk files were checked."""
    return map_flat(chunk_paths(root, spec), spec.chunk_bytes, spec.shape, spec.dtype)
