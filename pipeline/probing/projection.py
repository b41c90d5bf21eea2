"""Many numbers as few: standardised, and where they are too many along their main directions."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

_POWERS = 2
"""Passes that sharpen the directions; two suffice where the spectrum falls slowly."""
_SPARE = 10
"""Directions that are followed and not kept."""
_TINY = 1e-12


@dataclass(frozen=True, eq=False)
class Projection:
    """Standardises inputs, then takes some of their directions; all where `basis` is None.

    Fitted on a sample of the inputs alone, which says nothing of any action.
    """

    mean: Tensor
    """(channel,)"""
    scale: Tensor
    """(channel,) what to multiply by; 0 for a channel that does not vary in the sample."""
    basis: Tensor | None
    """(channel, direction)"""

    @classmethod
    def fit(cls, sample: Tensor, width: int | None = None, seed: int = 0) -> "Projection":
        """Of a `sample` (row, channel) in float64, on `width` directions where it is wider."""
        mean = sample.mean(dim=0)
        spread = sample.std(dim=0, correction=0)
        floor = _TINY + 1e-7 * mean.abs()
        scale = torch.where(spread > floor, 1 / spread, 0.0)
        basis = None
        if width is not None and width < sample.shape[1]:
            basis = main_directions((sample - mean) * scale, width, seed)
        return cls(mean, scale, basis)

    def __call__(self, values: Tensor) -> Tensor:
        """(row, channel) as (row, direction), in float64."""
        standard = (values.double() - self.mean).mul_(self.scale)
        return standard if self.basis is None else standard @ self.basis

    @property
    def width(self) -> int:
        """What it gives a row."""
        return len(self.mean) if self.basis is None else self.basis.shape[1]


@dataclass(frozen=True, eq=False)
class GroupedProjection:
    """A projection for each group of channels, so that a narrow group is not lost in a wide one."""

    groups: Sequence[Tensor]
    """(channel,) indices of each."""
    projections: Sequence[Projection]

    @classmethod
    def fit(cls, sample: Tensor, groups: Sequence[Tensor], width: int) -> "GroupedProjection":
        """Each group on at most `width` directions."""
        return cls(groups, [Projection.fit(sample[:, one], width) for one in groups])

    def __call__(self, values: Tensor) -> Tensor:
        """(row, channel) as (row, direction), group after group."""
        pairs = zip(self.groups, self.projections, strict=True)
        return torch.cat([project(values[:, one]) for one, project in pairs], dim=1)

    @property
    def width(self) -> int:
        """What it gives a row."""
        return sum(one.width for one in self.projections)


def main_directions(sample: Tensor, width: int, seed: int = 0) -> Tensor:
    """(channel, direction) orthonormal directions that hold most of the sample's variance.

    Randomised subspace iteration (Halko, Martinsson & Tropp 2011, alg. 4.4), the same for the same
    sample and seed; fewer than `width` where the sample has fewer rows.
    """
    generator = torch.Generator().manual_seed(seed)
    kept = min(width, *sample.shape)
    followed = min(kept + _SPARE, *sample.shape)
    start = torch.randn((sample.shape[1], followed), generator=generator, dtype=torch.float64)
    range_ = torch.linalg.qr(sample @ start).Q
    for _ in range(_POWERS):
        range_ = torch.linalg.qr(sample @ torch.linalg.qr(sample.T @ range_).Q).Q
    return torch.linalg.svd(range_.T @ sample, full_matrices=False).Vh[:kept].T.contiguous()
