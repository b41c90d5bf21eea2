"""The slots of a row: which pooled vectors it holds, in which order, and how far each deviates."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import Pooling, VLMParams
from pipeline.base.errors import VLMError


@dataclass(frozen=True)
class Slot:
    """One pooled vector of a row: its layer, whether it is normed, and its tokens."""

    layer: int
    """Index from the first layer; never negative."""
    norm: bool
    pooling: str
    view: str | None = None
    cell: tuple[int, int] | None = None
    """Row and column in the `grid` of a view."""
    grid: tuple[int, int] = (4, 4)
    """Rows and columns into which the cell's view is cut."""

    def document(self) -> dict[str, Any]:
        """The slot as JSON-able values, without entries that do not apply.

        The grid is left out, because all cells together show it.
        """
        document = {name: value for name, value in vars(self).items() if value is not None}
        del document["grid"]
        return document | ({"cell": list(self.cell)} if self.cell else {})


def slots_of(vlm: VLMParams, layers: int, views: Sequence[str]) -> tuple[Slot, ...]:
    """The slots of `vlm` for a model with this many decoder layers and these views, in order.

    Raises `VLMError` for a layer that the model lacks, for a repeated entry, and where no slot is
    left.
    """
    for name, values in (("norms", vlm.norms), ("pooling", vlm.pooling)):
        if len(set(values)) < len(values):
            raise VLMError(f"vlm.{name}: each may stand once, found {list(values)}")
    slots = tuple(
        slot
        for layer in _resolved_layers(vlm.layers, layers)
        for norm in vlm.norms
        for pooling in vlm.pooling
        for slot in _slots_of(layer, norm, pooling, views, vlm.grid)
    )
    if not slots:
        raise VLMError(
            f"vlm.pooling {list(vlm.pooling)} gives nothing without a view; add `mean` or `last`"
        )
    return slots


def _slots_of(
    layer: int, norm: bool, pooling: Pooling, views: Sequence[str], grid: tuple[int, int]
) -> list[Slot]:
    if pooling == "view_mean":
        return [Slot(layer, norm, pooling, view) for view in views]
    if pooling == "grid":
        cells = list(product(range(grid[0]), range(grid[1])))
        return [Slot(layer, norm, pooling, view, cell, grid) for view in views for cell in cells]
    return [Slot(layer, norm, pooling)]


def slot_documents(slots: Sequence[Slot], variants: int) -> list[dict[str, Any]]:
    """All slots of a row as JSON-able values, one variant after the other if there are several."""
    if variants == 1:
        return [slot.document() for slot in slots]
    return [slot.document() | {"variant": v} for v in range(variants) for slot in slots]


def slot_name(document: Mapping[str, Any]) -> str:
    """A short name for a slot document of a spec, without its variant."""
    cell = ",".join(map(str, document.get("cell") or ()))
    layer = f"layer {document['layer']}{'' if document['norm'] else ' no norm'}"
    return " ".join(filter(None, (layer, document["pooling"], document.get("view"), cell)))


def _resolved_layers(layers: Sequence[int], count: int) -> tuple[int, ...]:
    resolved = tuple(layer + count if layer < 0 else layer for layer in layers)
    if not set(resolved) <= set(range(count)) or len(set(resolved)) < len(resolved):
        raise VLMError(
            f"vlm.layers: expected {-count} to {count - 1} for a model of {count} decoder layers, "
            f"each layer once, found {list(layers)}. Set vlm.layers to some of these"
        )
    return resolved


# Largest deviation of a number, relative to the root mean square of its slot, by the coarser of
# compute and storage dtype.
#
# Measured with the demo checkpoint on a CPU, against batches of 8 on one thread: batches of 1 and
# 3, two threads and eager attention move a number of 16 rows x 49 slots x 128 by at most 7e-6 in
# float32, 0.012 in float16 and 0.070 in bfloat16 (two of its steps after four layers). Deeper
# models deviate more, so a few times that is allowed, and in float32, where that is still small, a
# hundred times, because GPUs sum in other orders. A real fault deviates far more: another frame,
# prompt or weight changes numbers by about their own size.
TOLERANCES = {"float32": 1e-3, "float16": 5e-2, "bfloat16": 3e-1}


def tolerance_of(spec: Mapping[str, Any]) -> float:
    """The tolerance for features of this spec, relative to the root mean square of a slot."""
    return max(TOLERANCES[spec[dtype]] for dtype in ("compute_dtype", "storage_dtype"))


@dataclass(frozen=True)
class SlotDeviations:
    """The largest deviation of each slot of a row, (slot,): absolute, and `relative` to the root
    mean square of the stored slot; infinite or NaN where features are not finite."""

    absolute: NDArray[np.float64]
    relative: NDArray[np.float64]

    @property
    def worst(self) -> int:
        """The slot that deviates most."""
        return int(np.argmax(np.nan_to_num(self.relative, nan=np.inf)))

    def beyond(self, tolerance: float) -> list[int]:
        """The slots that deviate more, the worst first; includes every NaN."""
        order = np.argsort(-np.nan_to_num(self.relative, nan=np.inf), kind="stable")
        return [int(slot) for slot in order if not self.relative[slot] <= tolerance]


def slot_deviations(stored: NDArray[Any], today: NDArray[Any]) -> SlotDeviations:
    """The deviations of a row's features (slot, dim)."""
    numbers = stored.astype(np.float64)
    apart = np.abs(today.astype(np.float64) - numbers).max(axis=-1)
    rms = np.sqrt(np.mean(numbers**2, axis=-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(apart == 0, 0.0, apart / rms)  # a slot of zeros has no deviation
    return SlotDeviations(apart, relative)
