"""Token vectors -> slots.

Every pooling is a weighted sum over a row's real tokens, so one matrix product pools a batch of
rows of mixed lengths and views, and a slot without tokens is zero.
"""

from collections.abc import Sequence
from functools import lru_cache
from math import ceil, floor

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from pipeline.vlm.preparation import TokenLayout
from pipeline.vlm.slots import Slot


@lru_cache(maxsize=64)
def token_weights(slots: tuple[Slot, ...], layout: TokenLayout) -> NDArray[np.float32]:
    """Weight (slot, token) of each token in each slot; each slot sums to 1, or 0 without tokens."""
    weights = np.zeros((len(slots), layout.length), np.float32)
    for row, slot in zip(weights, slots, strict=True):
        tokens = _tokens_of(slot, layout)
        if tokens.size:
            row[tokens] = 1 / tokens.size
    weights.flags.writeable = False
    return weights


def _tokens_of(slot: Slot, layout: TokenLayout) -> NDArray[np.int64]:
    every = np.arange(layout.length)
    match slot.pooling:
        case "mean":
            return every
        case "image_mean":
            return layout.image_tokens()
        case "text_mean":
            return np.setdiff1d(every, layout.image_tokens())
        case "last":
            return every[-1:]
        case _:  # of a view: its mean, a grid's cell or a token
            return _view_tokens(slot, layout)


def _view_tokens(slot: Slot, layout: TokenLayout) -> NDArray[np.int64]:
    start = dict(layout.image_starts).get(slot.view or "")
    if start is None:
        return np.empty(0, np.int64)
    rows, columns = layout.grid
    tokens = start + np.arange(rows * columns).reshape(rows, columns)
    if slot.cell is not None:
        tokens = tokens[tuple(map(_extent, slot.cell, layout.grid, slot.grid))]
    return tokens.reshape(-1)


def _extent(cell: int, size: int, cells: int) -> slice:
    """The tokens of a cell along one axis, as in torch's adaptive average pooling."""
    return slice(floor(cell * size / cells), ceil((cell + 1) * size / cells))


def batch_weights(
    slots: tuple[Slot, ...], layouts: Sequence[TokenLayout], length: int
) -> Float[Tensor, "batch slot token"]:
    """`token_weights` of each row, padded on the right to `length` tokens."""
    weights = torch.zeros(len(layouts), len(slots), length)
    for row, layout in zip(weights, layouts, strict=True):
        row[:, : layout.length] = torch.tensor(token_weights(slots, layout))
    return weights


def pool(
    hidden: Float[Tensor, "batch token dim"],
    weights: Float[Tensor, "batch slot token"],
    real: Bool[Tensor, "batch token"] | None,
) -> Float[Tensor, "batch slot dim"]:
    """The slots, pooled in float32 over real tokens; `real` is None without padding."""
    tokens = hidden.to(torch.float32)
    if real is not None:
        # A weight of 0 is not enough: 0 x inf in the padding would be NaN.
        tokens = tokens.masked_fill(~real.unsqueeze(-1), 0)
    return torch.bmm(weights, tokens)
