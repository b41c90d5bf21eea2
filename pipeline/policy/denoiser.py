"""The network that diffusion and flow matching share: from a noisy chunk to its change."""

import math
from collections.abc import Sequence
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.policy.attention import Projected, TransformerLayer, learned
from pipeline.policy.expert import Chunk, Context, StepMask

FREQUENCIES = 64
"""Pairs of sine and cosine that encode a time."""


class Denoiser(nn.Module):
    """A transformer over the steps of a noisy chunk that attends to the context.

    The time shifts, scales and gates every layer: one network turns it into a modulation that all
    layers share, to which each adds a learned one (adaLN-single, Chen et al. 2023, section 2.3).
    Unlike there nothing starts at zero, so every weight learns from the first step on.
    """

    frequencies: Tensor

    def __init__(
        self, *, horizon: int, action_dim: int, dim: int, layers: int, heads: int, dropout: float
    ) -> None:
        super().__init__()
        # Periods from 0.004 to 4 in times from 0 to 1, as Black et al. 2024 (pi0) have them.
        periods = torch.logspace(math.log10(4e-3), math.log10(4.0), FREQUENCIES)
        self.register_buffer("frequencies", 2 * math.pi / periods, persistent=False)
        self.read = nn.Linear(action_dim, dim)
        self.positions = learned(horizon, dim)
        self.time = nn.Sequential(
            nn.Linear(2 * FREQUENCIES, dim), nn.SiLU(), nn.Linear(dim, dim), nn.SiLU()
        )
        self.modulation = nn.Linear(dim, 8 * dim)
        self.layer_modulation = learned(layers, 6, dim)
        self.layers = nn.ModuleList(
            TransformerLayer(dim, heads, dropout=dropout, cross=True) for _ in range(layers)
        )
        self.norm = nn.LayerNorm(dim)
        self.head = nn.Linear(dim, action_dim)
        for linear in (self.modulation, self.head):
            nn.init.normal_(linear.weight, std=0.02)
            nn.init.zeros_(linear.bias)

    def forward(
        self,
        noisy: Chunk,
        time: Float[Tensor, " batch"],
        context: Context | Sequence[Projected],
        valid: StepMask | None = None,
    ) -> Chunk:
        """The float32 prediction for every step of the chunk; times are in [0, 1].

        `context` may be the result of `prepare`. Steps that are not valid, beyond an episode's end,
        are never attended to, and predictions for them mean nothing.
        """
        if valid is not None:
            # Attention needs one token a row; a chunk without a valid step counts nothing anyway.
            valid = valid | ~valid.any(dim=1, keepdim=True)
        sources = [context] * len(self.layers) if isinstance(context, Tensor) else context
        angles = time.float().unsqueeze(-1) * self.frequencies
        waves = torch.cat([angles.sin(), angles.cos()], dim=-1)
        modulation = self.modulation(self.time(waves)).unflatten(-1, (8, -1))
        shared, last = modulation[:, :6], modulation[:, 6:]
        tokens = self.read(noisy) + self.positions
        for layer, source, own in zip(self.layers, sources, self.layer_modulation, strict=True):
            tokens = layer(tokens, valid, source, shared + own)
        shift, scale = last.unsqueeze(2).unbind(1)
        return self.head(self.norm(tokens) * (1 + scale) + shift).float()

    def prepare(self, context: Context) -> Sequence[Projected]:
        """The context as every layer attends to it, for a sampler of many steps."""
        return [cast(TransformerLayer, layer).project(context) for layer in self.layers]
