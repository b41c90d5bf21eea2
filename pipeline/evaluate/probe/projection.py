"""Many numbers as few: standardised, along main directions where they are too many, and limited."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_POWERS = 2
"""Passes that sharpen the directions; two suffice where the spectrum falls slowly."""
_SPARE = 10
"""Directions that are followed and not kept."""
_TINY = 1e-12
_ROUNDING = 1e-6
"""A spread below this share of the mean is what float32 and arithmetic leave of a constant."""
LIMIT = 5.0
"""Standard deviations from the mean, of any rows that a fold is trained on, that are kept."""
STILL = 0.1
"""What spreads less than this share of its spread over all folds, in rows that are trained on, is
taken as constant."""


@dataclass(frozen=True, eq=False)
class Projection:
    """Standardises inputs, takes some of their directions (all where `basis` is None), limits them.

    A joint that rests in all recordings but one has a spread of about 0 in what is trained on when
    that one is held out; in such units it would then be thousands, and so would the prediction. So
    a column z, of mean m_f and spread s_f over the rows of all folds but f, becomes

        min(max(z, max_f(m_f - LIMIT s_f)), min_f(m_f + LIMIT s_f))

    which for no fold lies further than `LIMIT` spreads from what it is trained on, and 0 where some
    s_f < `STILL` s, or the limits cross: from other recordings nothing can be learnt of it. What
    comes out has mean 0 and spread 1 over all folds. Everything is fitted on a sample of the inputs
    of all folds, which says nothing of any action; limits are not linear, so they cannot wait until
    sums are taken.
    """

    mean: Tensor
    """(channel,)"""
    scale: Tensor
    """(channel,) what to multiply by; 0 for a channel that does not vary in the sample."""
    basis: Tensor | None
    """(channel, direction)"""
    limits: "Limits"
    """Of what comes out."""

    @classmethod
    def fit(
        cls, sample: Tensor, fold: NDArray[np.int64], width: int | None = None, seed: int = 0
    ) -> "Projection":
        """Of a `sample` (row, channel) in float64, on `width` directions where it is wider.

        `fold` (row,) is the fold that each row is held out in.
        """
        mean = sample.mean(dim=0)
        spread = sample.std(dim=0, correction=0)
        scale = torch.where(spread > _TINY + _ROUNDING * mean.abs(), 1 / spread, 0.0)
        standard = (sample - mean) * scale
        basis = None
        if width is not None and width < sample.shape[1]:
            basis = main_directions(standard, width, seed)
            standard = standard @ basis
        return cls(mean, scale, basis, Limits.fit(standard, fold))

    def __call__(self, values: Tensor) -> Tensor:
        """(row, channel) as (row, direction), in float64."""
        standard = (values.double() - self.mean).mul_(self.scale)
        return self.limits(standard if self.basis is None else standard @ self.basis)

    @property
    def width(self) -> int:
        """What it gives a row."""
        return len(self.limits.unit)


@dataclass(frozen=True, eq=False)
class Limits:
    """Between which each column is kept, and its mean and spread there."""

    lower: Tensor
    """(column,)"""
    upper: Tensor
    mean: Tensor
    unit: Tensor
    """What to multiply by; 0 for a column that is taken as constant."""

    @classmethod
    def fit(cls, columns: Tensor, fold: NDArray[np.int64]) -> "Limits":
        """Of standardised `columns` (row, column), as `Projection` says."""
        held = torch.from_numpy(fold[None] == np.unique(fold)[:, None]).double()
        square = columns.square()
        rows = len(columns) - held.sum(dim=1, keepdim=True)
        mean = (columns.sum(dim=0) - held @ columns) / rows
        spread = ((square.sum(dim=0) - held @ square) / rows - mean * mean).clamp(min=0).sqrt()
        if len(held) < 2:  # A slot in one fold only: no fold is trained on it without another.
            mean, spread = columns.mean(dim=0)[None], columns.std(dim=0, correction=0)[None]
        lower = (mean - LIMIT * spread).amax(dim=0)
        upper = (mean + LIMIT * spread).amin(dim=0)
        kept = columns.clamp(lower, torch.maximum(lower, upper))
        within = kept.std(dim=0, correction=0)
        overall = columns.std(dim=0, correction=0)
        varies = (spread > STILL * overall).all(dim=0) & (upper > lower) & (within > _ROUNDING)
        return cls(
            lower,
            torch.maximum(lower, upper),
            kept.mean(dim=0),
            torch.where(varies, 1 / within, 0.0),
        )

    def __call__(self, columns: Tensor) -> Tensor:
        """(row, column) within the limits, standardised; in place."""
        columns = torch.minimum(torch.maximum(columns, self.lower, out=columns), self.upper)
        return columns.sub_(self.mean).mul_(self.unit)


@dataclass(frozen=True, eq=False)
class GroupedProjection:
    """A projection for each group of channels, so that a narrow group is not lost in a wide one."""

    groups: Sequence[Tensor]
    """(channel,) indices of each."""
    projections: Sequence[Projection]

    @classmethod
    def fit(
        cls, sample: Tensor, fold: NDArray[np.int64], groups: Sequence[Tensor], width: int
    ) -> "GroupedProjection":
        """Each group on at most `width` directions."""
        return cls(groups, [Projection.fit(sample[:, one], fold, width) for one in groups])

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
