"""Ages of readings: their encoding for a network, and windows resampled at even ages."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

_PERIODS = 8
_SHORTEST_PERIOD_S, _LONGEST_PERIOD_S = 0.5, 64.0
_LEAST_WEIGHT = 1e-3
"""A step with less total weight has no reading near it: float32 ages are rounded."""


def fourier(seconds: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch wave"]:
    """Sines and cosines of a duration at geometric periods from 0.5 s to 64 s."""
    steps = torch.linspace(0.0, 1.0, _PERIODS, device=seconds.device)
    period = _SHORTEST_PERIOD_S * (_LONGEST_PERIOD_S / _SHORTEST_PERIOD_S) ** steps
    angle = 2 * math.pi * seconds.float().unsqueeze(-1) / period
    return torch.cat([angle.sin(), angle.cos()], dim=-1)


class AgeEncoder(nn.Module):
    """Several ages (batch, age) in s to a vector (batch, width); an unknown age is NaN."""

    def __init__(self, ages: int, width: int) -> None:
        super().__init__()
        self.network = nn.Sequential(
            nn.Linear(ages * (2 * _PERIODS + 1), width), nn.GELU(), nn.Linear(width, width)
        )

    def forward(self, age_s: Float[Tensor, "batch age"]) -> Float[Tensor, "batch width"]:
        """Encode; the value behind an unknown age reaches neither output nor gradients."""
        known = ~age_s.isnan()
        # Masked before it is encoded: zero times the gradient of a NaN is NaN.
        waves = fourier(age_s.masked_fill(~known, 0.0)) * known.unsqueeze(-1)
        return self.network(torch.cat([waves, known.unsqueeze(-1)], dim=-1).flatten(1))


def even_ages(readings: int, span_s: float, like: Tensor) -> Float[Tensor, " reading"]:
    """The ages in s of readings spread evenly over a span; the newest has age 0."""
    steps = torch.arange(readings - 1, -1, -1, device=like.device, dtype=torch.float32)
    return steps * (span_s / readings)


def at_even_ages(
    values: Float[Tensor, "batch reading channel"],
    valid: Bool[Tensor, "batch reading"],
    age_s: Float[Tensor, "batch reading"],
    steps: int,
    span_s: float,
) -> tuple[Float[Tensor, "batch step channel"], Bool[Tensor, "batch step"]]:
    """Resample windows at `steps` even times of a span; also which steps have a valid reading near.

    The last step is at the newest valid reading, whatever its age, so readings as dense as the
    steps stay unchanged. The weight of a reading falls linearly with its distance in age. It is 0
    at the mean distance between readings or between steps, whichever is longer: sparse readings are
    interpolated and dense ones averaged, so nothing aliases. Weights are normalised (normalised
    convolution, Knutsson and Westin 1993), so padding does not affect its neighbours. The same
    signal recorded at two rates gives the same windows, up to the error of interpolation.
    """
    newest = age_s.masked_fill(~valid, torch.inf).amin(dim=1, keepdim=True)
    since = (age_s - newest).masked_fill(~valid, 0.0)
    gaps = (valid.sum(dim=1) - 1).clamp(min=1)
    between = (since.amax(dim=1) / gaps).clamp(min=span_s / steps)
    distance = (even_ages(steps, span_s, age_s)[:, None] - since[:, None, :]).abs()
    weight = (1 - distance / between[:, None, None]).clamp(min=0) * valid[:, None, :]
    total = weight.sum(dim=-1, keepdim=True)
    stands = total > _LEAST_WEIGHT
    weight = torch.where(stands, weight / total.clamp(min=_LEAST_WEIGHT), 0.0)
    known = values.masked_fill(~valid.unsqueeze(-1), 0.0)
    return weight.to(values.dtype) @ known, stands.squeeze(-1)
