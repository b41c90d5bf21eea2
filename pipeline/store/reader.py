"""Open a finished store and gather batches from it at memory speed."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from pipeline.errors import StoreIncomplete, StoreMismatch
from pipeline.store.batch import Batch
from pipeline.store.gather import Gatherer
from pipeline.store.mapping import map_flat
from pipeline.store.schema import SCHEMA, TRAILER_BYTES, ArraySpec, chunk_paths, read_specs


@dataclass(frozen=True)
class Episode:
    """One episode and the rows of each array that belong to it."""

    index: int
    id: str
    source: str
    path: str
    format: str
    instruction: str
    content: str
    """Digest of its files."""
    digest: str
    """Digest of its content and of everything else that decides its rows."""
    ticks: range
    vl_rows: range
    readings: range
    states: range


class FeatureStore:
    """A finished store, mapped read-only; opening costs milliseconds whatever its size.

    Survives `fork`; pickling reopens it, so that it can be sent to spawned workers.
    """

    def __init__(self, path: Path, attrs: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]):
        self.path = path
        self.attrs = attrs
        self._arrays = arrays

    @classmethod
    def open(cls, path: str | Path) -> "FeatureStore":
        """Map a store.

        Raises `StoreIncomplete` when it is not there, unfinished or damaged, `StoreMismatch` when
        it follows another schema.
        """
        root = Path(path)
        if not (root / "zarr.json").exists():
            part = root.with_name(root.name + ".part")
            found = f"only the unfinished build {part}" if part.exists() else "nothing there"
            raise StoreIncomplete(f"{root}: no finished store ({found}). Run stages.extract.")
        try:
            attrs = zarr.open_group(root, mode="r").attrs.asdict()
        except (ValueError, KeyError) as error:
            raise StoreIncomplete(
                f"{root / 'zarr.json'}: not a zarr group's metadata ({error}). Remove {root} and "
                "run stages.extract again."
            ) from None
        if attrs.get("schema") != SCHEMA:
            raise StoreMismatch(
                f"{root}: expected store schema {SCHEMA}, found {attrs.get('schema')!r}. "
                "Extract it again with this version."
            )
        specs = read_specs(root)
        return cls(root, attrs, {name: _mapped(root, spec) for name, spec in specs.items()})

    def __reduce__(self) -> tuple[Any, ...]:
        return FeatureStore.open, (self.path,)

    def array(self, name: str) -> NDArray[Any]:
        """Any array of the store by name, mapped; what is written into it is never kept."""
        return self._arrays[name]

    @property
    def spec(self) -> dict[str, Any]:
        """The feature spec: the whole document and its digest."""
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
        """Ticks a second; None where the recorded rows are the ticks."""
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
        _, slots, dim = self._arrays["vl/features"].shape
        return slots // self.variants, dim

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
    def episodes(self) -> tuple[Episode, ...]:
        """All episodes, in order."""
        edges = {
            kind: self._arrays[f"episode/{kind}_start"].tolist()
            for kind in ("tick", "vl", "sensor", "state", "text")
        }
        text = self._arrays["episode/text"].tobytes()
        source = self._arrays["episode/source"]
        found = []
        for index in range(len(source)):
            rows = {kind: range(edge[index], edge[index + 1]) for kind, edge in edges.items()}
            said = json.loads(text[rows["text"].start : rows["text"].stop])
            found.append(
                Episode(
                    index=index,
                    source=self.sources[source[index]],
                    ticks=rows["tick"],
                    vl_rows=rows["vl"],
                    readings=rows["sensor"],
                    states=rows["state"],
                    **said,
                )
            )
        return tuple(found)

    def episode_of(self, ticks: NDArray[np.int64]) -> NDArray[np.int64]:
        """The index of the episode of each of these store-global ticks."""
        return np.searchsorted(self._arrays["episode/tick_start"], ticks, side="right") - 1

    def gather(
        self,
        ticks: Sequence[int] | NDArray[np.int64],
        horizon: int = 8,
        sensor_window: int = 65,
        state_window: int = 100,
        feature_lag: int = 0,
        sensor_lag_s: float = 0.0,
        state_lag_s: float = 0.0,
        out: Batch | None = None,
        variants: NDArray[np.int64] | None = None,
    ) -> Batch:
        """The batch of these ticks (store-global), into the buffers of `out` where given.

        Windows end at the last reading at or before the tick less the lag; `feature_lag` goes back
        whole VL rows, not beyond the episode's first. The action chunk begins at its own tick and
        repeats the episode's last action, marked invalid, beyond its end. `variants` (batch,) says
        which variant of its VL row each tick sees; without it all see 0, the plain frames.

        Raises `IndexError` for a tick the store does not have and `ValueError` for a variant it
        does not have, an `out` of other sizes, or a negative lag, which would show the future.
        """
        if min(feature_lag, sensor_lag_s, state_lag_s) < 0:
            raise ValueError(
                f"a lag goes back in time and cannot be negative: feature_lag={feature_lag}, "
                f"sensor_lag_s={sensor_lag_s}, state_lag_s={state_lag_s}"
            )
        tick = np.asarray(ticks, np.int64)
        if tick.size and (tick.min() < 0 or tick.max() >= self.ticks):
            raise IndexError(f"{self.path}: ticks lie in 0..{self.ticks - 1}, asked for {tick}")
        if variants is not None:
            self._check_variants(variants, len(tick))
        sizes = (len(tick), horizon, sensor_window, state_window)
        batch = self.empty_batch(*sizes) if out is None else out
        if batch.sizes != sizes:
            raise ValueError(
                "`out` has (batch, horizon, sensor_window, state_window) "
                f"{batch.sizes}, asked for {sizes}"
            )
        self._gatherer.gather(batch, tick, feature_lag, sensor_lag_s, state_lag_s, variants)
        return batch

    def empty_batch(self, batch: int, horizon: int, sensor_window: int, state_window: int) -> Batch:
        """Buffers for `gather(..., out=)`."""
        return self._gatherer.empty_batch(batch, horizon, sensor_window, state_window)

    @cached_property
    def _gatherer(self) -> Gatherer:
        return Gatherer(self._arrays, self.variants)

    def _check_variants(self, variants: NDArray[np.int64], batch: int) -> None:
        if variants.shape != (batch,):
            raise ValueError(
                f"`variants` names one a tick: expected shape ({batch},), found {variants.shape}"
            )
        if variants.size and (variants.min() < 0 or variants.max() >= self.variants):
            raise ValueError(
                f"{self.path}: variants lie in 0..{self.variants - 1}, asked for "
                f"{variants.min()}..{variants.max()}. A store holds `vlm.variants` of them."
            )


def _mapped(root: Path, spec: ArraySpec) -> NDArray[Any]:
    paths = chunk_paths(root, spec)
    wanted = spec.chunk_bytes + TRAILER_BYTES
    for path in paths:
        size = path.stat().st_size if path.exists() else None
        if size != wanted:
            found = "no file" if size is None else f"{size} bytes"
            raise StoreIncomplete(
                f"{path}: expected {wanted} bytes, found {found}. The store is damaged: remove "
                f"{root} and run stages.extract again."
            )
    return map_flat(paths, spec.chunk_bytes, spec.shape, spec.dtype)
