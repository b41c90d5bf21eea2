"""Encoder of the frozen model's pooled features: a token a slot, which knows its place and age."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pipeline.policy.ages import AgeEncoder
from pipeline.policy.attention import learned


class FeatureEncoder(nn.Module):
    """Tokens (batch, slot, width) for normalised features (batch, slot, dim) and their age.

    All slots share one projection to `width`, which keeps the cost at dim·width a slot; an
    embedding of its own tells a grid cell from the next. The ages in s, since the newest frame and
    since that of each view, are added to every token and tell how stale the vision is. A slot that
    is not valid is a learned embedding of its own, which has no age.
    """

    def __init__(
        self, slots: int, feature_dim: int, width: int | None = None, views: int = 0
    ) -> None:
        super().__init__()
        self.slots = slots
        # Few slots carry much each: 512 wide for a single mean, 64 for a grid cell.
        self.width = width or min(feature_dim, max(64, 512 // slots))
        self.squeeze = nn.Linear(feature_dim, self.width)
        self.slot = learned(slots, self.width)
        self.missing = learned(slots, self.width)
        self.norm = nn.LayerNorm(self.width)
        self.age = AgeEncoder(1 + views, self.width)

    def forward(
        self,
        features: Float[Tensor, "batch slot dim"],
        slot_valid: Bool[Tensor, "batch slot"],
        age_s: Float[Tensor, " batch"],
        view_age_s: Float[Tensor, "batch view"] | None = None,
    ) -> Float[Tensor, "batch slot width"]:
        """Encode; what stands in a slot that is not valid never reaches output or gradients.

        Nor do the ages of a sample without any valid slot. That of a missing view is NaN.
        """
        absent = ~slot_valid.unsqueeze(-1)
        slots = self.squeeze(features.masked_fill(absent, 0.0)) + self.slot
        slots = torch.where(absent, self.missing.to(slots.dtype), slots)
        slots = nn.functional.gelu(self.norm(slots), approximate="tanh")
        ages = age_s[:, None]
        if view_age_s is not None:
            ages = torch.cat([ages, view_age_s], dim=1)
        ages = ages.masked_fill(~slot_valid.any(dim=1, keepdim=True), torch.nan)
        return slots + self.age(ages).unsqueeze(1).masked_fill(absent, 0.0)
