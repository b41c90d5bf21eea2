"""The slots of a row: which pooled vectors it holds, and in which order."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

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
