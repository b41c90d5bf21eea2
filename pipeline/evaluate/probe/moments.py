"""What a regression has to know of rows: sums, which parts of them add up to."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

VARIES = 1e-6
"""A standard deviation below this share of the whole data's is rounding, not signal."""


@dataclass(frozen=True, eq=False)
class Moments:
    """Sums over rows z = (inputs, targets): their number, sum z and sum z z', in float64.

    Inputs and targets have about mean 0 and spread 1 over the whole store, so that differences of
    sums lose nothing.
    """

    rows: float
    sum: Tensor
    """(column,)"""
    gram: Tensor
    """(column, column)"""

    def __add__(self, other: "Moments") -> "Moments":
        return Moments(self.rows + other.rows, self.sum + other.sum, self.gram + other.gram)

    def last(self, columns: int) -> "Moments":
        """Of so many last columns alone."""
        return Moments(self.rows, self.sum[-columns:], self.gram[-columns:, -columns:])


def total(parts: Sequence[Moments]) -> Moments:
    """Over all parts, in their order."""
    return sum(parts[1:], start=parts[0])


def variance(moments: Moments, targets: int) -> Tensor:
    """(target,), 0 where it does not vary."""
    mean = moments.sum / moments.rows
    square = (moments.gram.diagonal() / moments.rows - mean * mean)[-targets:]
    return torch.where(square > VARIES**2, square, 0.0)
