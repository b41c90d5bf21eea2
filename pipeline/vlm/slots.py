"""The slots of a row: which pooled vectors it holds, in which order, and how far each deviates."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import GridPooling, Layer, Pooling, VLMParams
from pipeline.base.errors import VLMError

_WITH_TEXT = ("mean", "text_mean", "last")
"""Poolings of tokens that the vision tower lacks."""


@dataclass(frozen=True)
class Slot:
    """One pooled vector of a row: its layer, whether it is normed, and its tokens."""

    layer: Layer
    """Index from the first layer, never negative; or the vision tower."""
    norm: bool
    pooling: str
    view: str | None = None
    cell: tuple[int, int] | None = None
    """Row and column in the `grid` of a view, or of a token."""
    grid: tuple[int, int] = (4, 4)
    """Rows and columns into which the cell's view is cut."""

    def document(self) -> dict[str, Any]:
        """The slot as JSON-able values, without entries that do not apply.

        The grid is left out, because all cells together show it.
        """
        document = {name: value for name, value in vars(self).items() if value is not None}
        del document["grid"]
        return document | ({"cell": list(self.cell)} if self.cell else {})


def slots_of(
    vlm: VLMParams, layers: int, views: Sequence[str], tokens: tuple[int, int]
) -> tuple[Slot, ...]:
    """The slots of `vlm` for a model with this many decoder layers and these views, in order.

    `tokens` are the rows and columns of a view's image tokens. The vision tower has no final norm,
    so `norms` does not multiply its slots. Raises `VLMError` for a layer that the model lacks, for
    text of the vision tower, and where no slot is left.
    """
    if "vision" in vlm.layers and (text := [p for p in vlm.pooling if p in _WITH_TEXT]):
        raise VLMError(
            f"vlm.pooling {', '.join(map(str, text))}: the vision tower of vlm.layers sees no "
            "text. Use image_mean, view_mean, grid or tokens, or leave out the layer vision"
        )
    slots = tuple(
        slot
        for layer in _resolved_layers(vlm.layers, layers)
        for norm in ((False,) if layer == "vision" else vlm.norms)
        for pooling in vlm.pooling
        for slot in _slots_of(layer, norm, pooling, views, vlm.grid, tokens)
    )
    if not slots:
        raise VLMError(
            f"vlm.pooling {list(vlm.pooling)} gives nothing without a view; add `mean` or `last`"
        )
    return slots


def _slots_of(
    layer: Layer,
    norm: bool,
    pooling: Pooling,
    views: Sequence[str],
    grid: tuple[int, int],
    tokens: tuple[int, int],
) -> list[Slot]:
    name = str(pooling)
    if name == "view_mean":
        return [Slot(layer, norm, name, view) for view in views]
    if isinstance(pooling, GridPooling) or name in ("grid", "tokens"):
        grid = pooling.grid if isinstance(pooling, GridPooling) else grid
        grid = tokens if name == "tokens" else grid
        cells = list(product(range(grid[0]), range(grid[1])))
        return [Slot(layer, norm, name, view, cell, grid) for view in views for cell in cells]
    return [Slot(layer, norm, name)]


def slot_documents(slots: Sequence[Slot], variants: int) -> list[dict[str, Any]]:
    """All slots of a row as JSON-able values, one variant after the other if there are several."""
    if variants == 1:
        return [slot.document() for slot in slots]
    return [slot.document() | {"variant": v} for v in range(variants) for slot in slots]


def slot_name(document: Mapping[str, Any]) -> str:
    """A short name for a slot document of a spec, without its variant."""
    cell = ",".join(map(str, document.get("cell") or ()))
    layer = layer_name(document["layer"], document["norm"])
    return " ".join(filter(None, (layer, document["pooling"], document.get("view"), cell)))


def layer_name(layer: Layer, norm: bool) -> str:
    """A short name for the layer that a slot is taken from."""
    return "vision tower" if layer == "vision" else f"layer {layer}{'' if norm else ', no norm'}"


def _resolved_layers(layers: Sequence[Layer] | Literal["all"], count: int) -> tuple[Layer, ...]:
    if layers == "all":
        return tuple(range(count))
    resolved: list[Layer] = [
        layer + count if isinstance(layer, int) and layer < 0 else layer for layer in layers
    ]
    if not {*resolved} <= {*range(count), "vision"} or len({*resolved}) < len(resolved):
        raise VLMError(
            f"vlm.layers: expected {-count} to {count - 1} for a model of {count} decoder layers, "
            f"or vision, each layer once, found {list(layers)}. Set vlm.layers to some of these"
        )
    return tuple(resolved)


# Largest deviation of a number, relative to its slot (`slot_deviations`), by the coarser of compute
# and storage dtype.
#
# Measured with the demo checkpoint on a CPU, against batches of 8 on one thread: batches of 1 and
# 3, two threads and eager attention move a number of 16 rows x 49 slots x 128 by at most 7e-6 in
# float32, 0.012 in float16 and 0.070 in bfloat16 (two of its steps after four layers). Deeper
# models deviate more, so a few times that is allowed, and in float32, where that is still small, a
# hundred times, because GPUs sum in other orders. A real fault deviates far more: another frame,
# prompt or weight changes numbers by about their own size. In int8 and float8 noise may move a
# number to the next code, which `slot_deviations` forgives.
TOLERANCES = {"float32": 1e-3, "float16": 5e-2, "bfloat16": 3e-1, "float8": 5e-2, "int8": 5e-2}


def tolerance_of(spec: Mapping[str, Any]) -> float:
    """The tolerance for features of this spec, relative as in `slot_deviations`."""
    return max(TOLERANCES[spec[dtype]] for dtype in ("compute_dtype", "storage_dtype"))


def slot_deviations(
    stored: NDArray[Any], today: NDArray[Any], code: NDArray[Any] | float = 0.0
) -> NDArray[np.float64]:
    """The largest deviation in each slot of a row (slot, dim) beyond one `code` of its dtype.

    It is relative to the stored number, or to the root mean square of the slot without its largest
    tenth where that is more: a few channels hundreds of times larger than the others, as large
    models have, neither hide a fault in these nor are one by their own rounding. Infinite where
    features are not finite, and where a slot of zeros is no longer zero.
    """
    numbers = stored.astype(np.float64)
    apart = np.maximum(np.abs(today.astype(np.float64) - numbers) - code, 0.0)
    most = np.abs(numbers)
    usual = np.sort(most, axis=-1)[..., : math.ceil(0.9 * most.shape[-1])]
    size = np.maximum(most, np.sqrt(np.mean(usual**2, axis=-1, keepdims=True)))
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(apart == 0, 0.0, apart / size)  # a slot of zeros has no deviation
    return np.nan_to_num(relative.max(axis=-1), nan=np.inf, posinf=np.inf)
