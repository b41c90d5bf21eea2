"""What a store, a build or an archive says it holds, read from metadata and a small array."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from pipeline.base.errors import StoreIncomplete
from pipeline.store.archive.manifest import read_manifest
from pipeline.store.chunks import read_rows
from pipeline.store.paths import read_plan
from pipeline.store.schema import CHECKSUMS, FEATURES, ArraySpec, read_specs


@dataclass(frozen=True)
class Contents:
    """What a store, an archive of one or a build says it holds."""

    plan: str | None
    spec: Mapping[str, Any]
    attrs: Mapping[str, Any]
    episodes: int
    ticks: int
    rows: int
    done: int
    """Feature rows that are there; fewer than `rows` in a build."""
    widths: Mapping[str, int]
    """Channels of action, sensor and state; 0 for an absent stream."""
    features: tuple[int, int, str]
    """Slots of all variants, width, and stored dtype of a feature row."""
    sensor_dtype: str


def contents_of(path: Path) -> Contents:
    """Of a store or a laid-out build; raises `StoreIncomplete` where either is damaged."""
    specs = read_specs(path)
    done = np.count_nonzero(read_rows(path, specs[CHECKSUMS]))
    return _described(path, specs, read_plan(path), int(done))


def contents_of_archive(path: Path) -> Contents:
    """Of a complete archive: what the store that it was made of held."""
    specs = read_specs(path)
    return _described(path, specs, read_manifest(path).plan, specs[CHECKSUMS].shape[0])


def _described(path: Path, specs: Mapping[str, ArraySpec], plan: str | None, done: int) -> Contents:
    attrs: dict[str, Any] = zarr.open_group(path, mode="r").attrs.asdict()
    features = specs[FEATURES]
    if not {"feature_spec", "streams", "sources", "action_hz", "vlm_reuse_count"} <= set(attrs):
        raise StoreIncomplete(f"{path}: its attributes lack what a store says of itself")
    return Contents(
        plan=plan,
        spec=attrs["feature_spec"],
        attrs=attrs,
        episodes=specs["episode/source"].shape[0],
        ticks=specs["tick/time"].shape[0],
        rows=features.shape[0],
        done=done,
        widths={
            "action": specs["tick/action"].shape[1],
            "sensor": specs["sensor/values"].shape[1],
            "state": specs["state/values"].shape[1],
        },
        features=(
            features.shape[1],
            features.shape[2],
            features.attributes.get("dtype", features.dtype.name),
        ),
        sensor_dtype=specs["sensor/values"].dtype.name,
    )
