"""Fewer numbers a slot: its features on their main directions (PCA).

A basis is an affine map for each group of slots of one layer, norm and pooling: views and cells
share it. Channels are standardised first, because a few channels of large models are hundreds of
times larger than the others; the result is, too, so that every coefficient costs an integer dtype
as much of its precision.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import ConfigError

SAMPLE_ROWS = 1024
"""Most rows of the sample that a map is fitted to, evenly spread."""
SLOTS_A_ROW = 4
"""Most slots of a group that a row of the sample gives."""
_LEAST_SPREAD = 1e-3
"""A share of a channel's size: a smaller spread may be rounding, which is not made larger."""
_LEAST_VARIANCE = 0.1
"""A share of a channel's variance: directions of less, and the model's noise in them, are not made
larger than that allows."""


@dataclass(frozen=True, eq=False)
class Basis:
    """The map of each group: features x become `x @ maps[group, :-1] + maps[group, -1]`."""

    maps: NDArray[np.float32]
    """(group, channel + 1, rank)"""

    @cached_property
    def digest(self) -> str:
        """32 hex digits of BLAKE2b of its shape and numbers."""
        hasher = hashlib.blake2b(repr(self.maps.shape).encode(), digest_size=16)
        hasher.update(np.ascontiguousarray(self.maps, "<f4").data)
        return hasher.hexdigest()


def slot_groups(slots: Sequence[Mapping[str, Any]]) -> list[list[Mapping[str, Any]]]:
    """The slot documents of the first variant by layer, norm and pooling, in order."""
    plain = (slot for slot in slots if not slot.get("variant"))
    named = groupby(plain, lambda slot: (slot["layer"], slot["norm"], slot["pooling"]))
    return [[*group] for _, group in named]


def group_sizes(slots: Sequence[Mapping[str, Any]]) -> tuple[int, ...]:
    """How many slots each group of the first variant has, in order."""
    return tuple(map(len, slot_groups(slots)))


def fit_map(values: NDArray[np.floating[Any]], rank: int) -> tuple[NDArray[np.float32], float]:
    """The map (channel + 1, rank) of a group with these features (row, channel), `rank` <= channel.

    It gives coefficients of mean 0 and, in directions that vary, spread 1, the largest direction
    first. Also returns the share of the standardised variance that the coefficients keep. Equal
    values give equal bits on one machine. Raises `ConfigError` unless there are more rows than
    `rank`.
    """
    if len(values) <= rank:
        raise ConfigError(
            f"pca {rank}: its directions are fitted to more than {rank} features of each layer, "
            f"norm and pooling; one of these has {len(values)}. Set a smaller pca, take more "
            "recordings or ticks, or leave out a view that hardly any of them has."
        )
    rows = values.astype(np.float64)
    mean, size = rows.mean(axis=0), np.sqrt(np.mean(rows**2, axis=0))
    scale = np.maximum(rows.std(axis=0), np.maximum(_LEAST_SPREAD * size, 1e-30))
    standard = (rows - mean) / scale
    variances, directions = np.linalg.eigh(standard.T @ standard / len(rows))
    kept = directions[:, ::-1][:, :rank]
    kept = kept * np.sign(kept[np.abs(kept).argmax(axis=0), np.arange(rank)])
    largest = variances[::-1][:rank]
    linear = kept / scale[:, None] / np.sqrt(np.maximum(largest, _LEAST_VARIANCE))
    share = largest.sum() / max(variances.sum(), 1e-30)
    return np.concatenate([linear, -(mean @ linear)[None]]).astype(np.float32), float(share)


def apply_map(
    values: NDArray[np.floating[Any]], affine: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Features (row, channel) as coefficients (row, rank)."""
    return (values @ affine[:-1] + affine[-1]).astype(np.float32)
