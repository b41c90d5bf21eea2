"""Encoder of the frozen model's pooled features: a token a slot, which knows its place and age."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pipeline.policy.attention import learned

_AGE_PERIODS = 8
_SHORTEST_PERIOD_S, _LONGEST_PERIOD_S = 0.5, 64.0


class FeatureEncoder(nn.Module):
    """Tokens (batch, slot, width) for normalised features (batch, slot, dim) and their age.

    All slots share one projection to `width`, which keeps the cost at dim·width a slot; an
    embedding of its own tells a grid cell from the next. The age, in s since the newest frame,
    is added to every token and tells how stale the vision is. A slot that is not valid is a
    learned embedding of its own, which has no age.
    """

    def __init__(self, slots: int, feature_dim: int, width: int | None = None) -> None:
        super().__init__()
        self.slots = slots
        # Few slots carry much each: 512 wide for a single mean, 64 for a grid cell.
        self.width = width or min(feature_dim, max(64, 512 // slots))
        self.squeeze = nn.Linear(feature_dim, self.width)
        self.slot = learned(slots, self.width)
        self.missing = learned(slots, self.width)
        self.norm = nn.LayerNorm(self.width)
        self.age = nn.Sequential(
            nn.Linear(2 * _AGE_PERIODS, self.width), nn.GELU(), nn.Linear(self.width, self.width)
        )

    def forward(
        self,
        features: Float[Tensor, "batch slot dim"],
        slot_valid: Bool[Tensor, "batch slot"],
        age_s: Float[Tensor, " batch"],
    ) -> Float[Tensor, "batch slot width"]:
        """Encode; what stands in a slot that is not valid never reaches output or gradients.

        Nor does the age of a sample without any valid slot.
        """
        absent = ~slot_valid.unsqueeze(-1)
        slots = self.squeeze(features.masked_fill(absent, 0.0)) + self.slot
        slots = torch.where(absent, self.missing.to(slots.dtype), slots)
        slots = nn.functional.gelu(self.norm(slots), approximate="tanh")
        # Masked before it is encoded: zero times the gradient of a NaN is NaN.
        known_s = age_s.masked_fill(~slot_valid.any(dim=1), 0.0)
        return slots + self.age(fourier(known_s)).unsqueeze(1).masked_fill(absent, 0.0)


def fourier(seconds: Float[Tensor, " batch"]) -> Float[Tensor, "batch wave"]:
    """Sines and cosines of a duration at geometric periods from 0.5 s to 64 s."""
    steps = torch.linspace(0.0, 1.0, _AGE_PERIODS, device=seconds.device)
    period = _SHORTEST_PERIOD_S * (_LONGEST_PERIOD_S / _SHORTEST_PERIOD_S) ** steps
    angle = 2 * math.pi * seconds.float().unsqueeze(-1) / period
    return torch.cat([angle.sin(), angle.cos()], dim=-1)
