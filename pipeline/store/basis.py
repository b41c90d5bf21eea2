"""The basis of projected features, which a build takes over from the store before it."""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import ConfigError, StoreIncomplete
from pipeline.base.projection import Basis
from pipeline.store.chunks import read_rows
from pipeline.store.documents import store_border
from pipeline.store.paths import KEPT, builds_aside, group_attributes, part_path, previous_path
from pipeline.store.schema import BASIS, read_spec


def checked_basis(root: Path, digest: str, maps: NDArray[np.float32]) -> Basis:
    """The basis in a store; `StoreIncomplete` where it does not give the digest of the spec."""
    basis = Basis(maps)
    if basis.digest != digest:
        what = f"expected the basis of digest {digest} in the feature spec, found {basis.digest}"
        raise store_border(root).refusal(root / BASIS, what)
    return basis


def known_basis(target: Path, spec: Mapping[str, Any]) -> Basis | None:
    """The basis of the build or store at the places of `target` whose spec is else equal to `spec`.

    A damaged basis does not count.
    """
    previous = previous_path(target)
    places = [part_path(target), *builds_aside(target), target]
    for place in [*places, *([previous] if KEPT.owns(previous) else [])]:
        stored = group_attributes(place).get("feature_spec", {})
        if "pca" in stored and _plain(stored) == _plain(spec):
            with suppress(StoreIncomplete):
                return _read(place, stored["pca"].get("basis", ""))
    return None


def basis_of(store: Path, shape: tuple[int, int, int]) -> Basis:
    """The basis of a store that the user names.

    Raises `ConfigError` where it has none of this shape (group, channel + 1, rank), and
    `StoreIncomplete` where it is damaged.
    """
    stored = group_attributes(store).get("feature_spec", {})
    basis = _read(store, stored["pca"].get("basis", "")) if "pca" in stored else None
    if basis is None or basis.maps.shape != shape:
        raise ConfigError(
            f"extract.dtype.basis: expected a store whose features are projected, with a basis of "
            f"the shape {shape}, found {basis.maps.shape if basis else 'none'} in {store}. Name "
            "another, or set it to null."
        )
    return basis


def _read(root: Path, digest: str) -> Basis:
    return checked_basis(root, digest, read_rows(root, read_spec(root, BASIS)))


def _plain(spec: Mapping[str, Any]) -> dict[str, Any]:
    """A spec without the digest and the basis."""
    kept = {name: value for name, value in spec.items() if name != "digest"}
    return kept | {"pca": {**spec["pca"], "basis": None}}
