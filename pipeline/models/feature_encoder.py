"""Encoder of the frozen model's pooled features: one vector that still knows where things were."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pipeline.models.attention import learned

_AGE_PERIODS = 8
_SHORTEST_PERIOD_S, _LONGEST_PERIOD_S = 0.5, 64.0


class FeatureEncoder(nn.Module):
    """One vector (batch, output_dim) for normalised features (batch, slot, dim) and their age.

    A projection that all slots share, to `slot_width`, keeps the cost at
    dim·slot_width + slots·slot_width·output_dim; then the slots are laid side by side, so that a
    grid cell keeps its place. A slot that is not valid is a learned embedding of its own. The age,
    in s since the newest frame, tells how stale the vision is.
    """

    def __init__(
        self, slots: int, feature_dim: int, output_dim: int = 512, slot_width: int | None = None
    ) -> None:
        super().__init__()
        # Few slots carry much each: 512 wide for a single mean, 64 for a grid cell.
        width = slot_width or min(feature_dim, max(64, 512 // slots))
        self.squeeze = nn.Linear(feature_dim, width)
        self.slot = learned(slots, width)
        self.missing = learned(slots, width)
        self.norm = nn.LayerNorm(width)
        self.project = nn.Linear(slots * width, output_dim)
        self.age = nn.Sequential(
            nn.Linear(2 * _AGE_PERIODS, output_dim), nn.GELU(), nn.Linear(output_dim, output_dim)
        )

    def forward(
        self,
        features: Float[Tensor, "batch slot dim"],
        slot_valid: Bool[Tensor, "batch slot"],
        age_s: Float[Tensor, " batch"],
    ) -> Float[Tensor, "batch output"]:
        """Encode; what stands in a slot that is not valid never reaches the output."""
        absent = ~slot_valid.unsqueeze(-1)
        slots = self.squeeze(features.masked_fill(absent, 0.0)) + self.slot
        slots = torch.where(absent, self.missing.to(slots.dtype), slots)
        slots = nn.functional.gelu(self.norm(slots), approximate="tanh")
        return self.project(slots.flatten(1)) + self.age(fourier(age_s))


def fourier(seconds: Float[Tensor, " batch"]) -> Float[Tensor, "batch wave"]:
    """Sines and cosines of a duration at geometric periods from 0.5 s to 64 s."""
    steps = torch.linspace(0.0, 1.0, _AGE_PERIODS, device=seconds.device)
    period = _SHORTEST_PERIOD_S * (_LONGEST_PERIOD_S / _SHORTEST_PERIOD_S) ** steps
    angle = 2 * math.pi * seconds.float().unsqueeze(-1) / period
    return torch.cat([angle.sin(), angle.cos()], dim=-1)
