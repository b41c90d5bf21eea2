"""The slots of a row: which pooled vectors it holds, and in which order."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from pipeline.base.config import Pooling, VLMParams
from pipeline.base.errors import VLMError


@dataclass(frozen=True)
class Slot:
    """One pooled vector of a row: which layer, normed or not, over which tokens."""

    layer: int
    """Counted from the first, so never negative."""
    norm: bool
    pooling: str
    view: str | None = None
    cell: tuple[int, int] | None = None
    """Row and column in the `grid` of a view."""
    grid: tuple[int, int] = (4, 4)
    """Rows and columns that the view of a cell is cut into."""

    def document(self) -> dict[str, Any]:
        """The slot as JSON-able values, without what does not apply.

        All cells together tell the grid, so it is not named.
        """
        document = {name: value for name, value in vars(self).items() if value is not None}
        del document["grid"]
        return document | ({"cell": list(self.cell)} if self.cell else {})


def slots_of(vlm: VLMParams, layers: int, views: Sequence[str]) -> tuple[Slot, ...]:
    """The slots that `vlm` asks of a model of this many decoder layers for these views, in order.

    Raises `VLMError` for a layer past the model, for what is asked twice, and where none is left.
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
    """The slots of a whole row as JSON-able values: variant after variant, where there are any."""
    if variants == 1:
        return [slot.document() for slot in slots]
    return [slot.document() | {"variant": v} for v in range(variants) for slot in slots]


def slot_name(document: Mapping[str, Any]) -> str:
    """A slot of any variant, as a spec describes it, in a few words."""
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
