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
        digest = stored.get("pca", {}).get("basis")
        if digest and _plain(stored) == _plain(spec):
            with suppress(StoreIncomplete):
                return checked_basis(place, digest, read_rows(place, read_spec(place, BASIS)))
    return None


def basis_of(store: Path, shape: tuple[int, int, int]) -> Basis:
    """The basis of a store that the user names.

    Raises `ConfigError` where it has none of this shape (group, channel + 1, rank), and
    `StoreIncomplete` where it is damaged.
    """
    stored = group_attributes(store).get("feature_spec", {}).get("pca")
    spec = read_spec(store, BASIS) if stored else None
    if spec is None or spec.shape != shape:
        raise ConfigError(
            f"extract.dtype.basis: expected a store whose features are projected, with a basis of "
            f"the shape {shape}, found {spec.shape if spec else 'none'} in {store}. Name another, "
            "or set it to null."
        )
    return checked_basis(store, stored["basis"], read_rows(store, spec))


def _plain(spec: Mapping[str, Any]) -> dict[str, Any]:
    """A spec without the digest and the basis."""
    kept = {name: value for name, value in spec.items() if name != "digest"}
    return kept | {"pca": {**spec["pca"], "basis": None}}
