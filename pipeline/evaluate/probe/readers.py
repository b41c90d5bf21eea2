"""What is read of a row: one slot, or all slots that one choice in params.yaml gives."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.base.errors import NumericsError
from pipeline.evaluate.probe.projection import Projection
from pipeline.store import FeatureStore, place

GROUP_WIDTH = 1024
"""Inputs at most that several slots together make."""
_SAMPLE_ROWS = 2048
"""That centres, spreads and directions are fitted on."""


@dataclass(frozen=True)
class SlotName:
    """What a slot or a group of slots is: of a group, `view` and `cell` are None."""

    layer: int
    norm: bool
    pooling: str
    view: str | None = None
    cell: tuple[int, int] | None = None

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> "SlotName":
        """As the store's attributes name it."""
        cell = document.get("cell")
        return cls(
            document["layer"],
            document["norm"],
            document["pooling"],
            document.get("view"),
            None if cell is None else (cell[0], cell[1]),
        )

    @property
    def group(self) -> "SlotName":
        """The choice of layer, norm and pooling that gave it."""
        return SlotName(self.layer, self.norm, self.pooling)

    @property
    def label(self) -> str:
        """In a few words."""
        said = f"layer {self.layer}{'' if self.norm else ', no norm'}, {self.pooling}"
        said += "" if self.view is None else f", {self.view}"
        return said + ("" if self.cell is None else f" cell {self.cell[0]},{self.cell[1]}")


@dataclass(frozen=True, eq=False)
class Reader:
    """Some slots of a row as inputs side by side."""

    slots: tuple[int, ...]
    """Of variant 0; none for what is read beside them."""
    projections: tuple[Projection, ...]
    """Of each slot."""

    @property
    def width(self) -> int:
        """Inputs a row."""
        return sum(one.width for one in self.projections)

    def __call__(self, values: NDArray[Any], valid: NDArray[np.bool_]) -> Tensor:
        """(row, input) in float64 of `values` (row, slot, dim), the reader's slots as stored.

        A slot that is not valid (row, slot) stands at its mean, which is 0.
        """
        parts = [torch.empty((len(values), 0), dtype=torch.float64)]
        for index, project in enumerate(self.projections):
            there = torch.from_numpy(valid[:, index, None])
            parts.append(torch.where(there, project(as_floats(values[:, index])), 0.0))
        return torch.cat(parts, dim=1) if len(parts) > 2 else parts[-1]


def slot_names(store: FeatureStore) -> list[SlotName]:
    """Of each slot of variant 0, in order."""
    slots, _ = store.feature_shape
    return [SlotName.of(document) for document in store.attrs["slots"][:slots]]


def groups_of(names: list[SlotName]) -> dict[SlotName, tuple[int, ...]]:
    """The slots of each choice of layer, norm and pooling, in the store's order."""
    found: dict[SlotName, list[int]] = {}
    for index, name in enumerate(names):
        found.setdefault(name.group, []).append(index)
    return {name: tuple(slots) for name, slots in found.items()}


def fit_reader(
    store: FeatureStore,
    rows: NDArray[np.int64],
    fold: NDArray[np.int64],
    slots: tuple[int, ...],
) -> Reader:
    """The reader of these slots, fitted on a sample of the VL `rows` that are read.

    `fold` (row,) is the fold that each of them is held out in.

    A single slot is read whole. Several share `GROUP_WIDTH` inputs, each on its main directions,
    where their own channels are more. Raises `NumericsError` on NaN or inf.
    """
    step = -(-len(rows) // _SAMPLE_ROWS)
    sample, held = rows[::step], fold[::step]
    width = GROUP_WIDTH // len(slots) if len(slots) > 1 else None
    projections = []
    for slot in slots:
        valid = store.array("vl/slot_valid")[sample, slot].astype(bool)
        values = store.array("vl/features")[sample[valid], slot]
        check(store, sample[valid], values[:, None], slot)
        there = as_floats(values).double()
        # A slot that is valid nowhere is at its mean everywhere, whatever that is.
        if not len(there):
            there, valid = torch.zeros((1, there.shape[1]), dtype=torch.float64), slice(1)
        projections.append(Projection.fit(there, held[valid], width))
    return Reader(slots, tuple(projections))


def check(
    store: FeatureStore,
    rows: NDArray[np.int64],
    values: NDArray[Any],
    first_slot: int,
    valid: NDArray[np.bool_] | None = None,
) -> None:
    """Raise `NumericsError`, naming the place, where a valid value (row, slot, dim) is no number.

    `rows` are the VL rows and `first_slot` the first of the slots that `values` hold.
    """
    floats = as_floats(values)
    # A sum over everything is finite where all of it is, and costs less than looking at each.
    if torch.isfinite(floats.sum(dtype=torch.float64)):
        return
    bad = ~torch.isfinite(floats)
    if valid is not None:
        bad &= torch.from_numpy(valid)[:, :, None]
    if bad.any():
        row, slot, channel = (int(one) for one in torch.nonzero(bad)[0])
        raise NumericsError(
            f"{store.path}: expected finite numbers, found {float(floats[row, slot, channel])} at "
            f"{place(store, 'vl', int(rows[row]))}, slot {first_slot + slot}, channel {channel}. "
            "Run stages.verify to see what else is damaged."
        )


def as_floats(values: NDArray[Any]) -> Tensor:
    """Features as stored, as a tensor of floating point."""
    tensor = torch.from_numpy(np.ascontiguousarray(values))
    return tensor.view(torch.bfloat16) if values.dtype == np.uint16 else tensor
