"""How the encoders' vectors become the context that an action expert attends to."""

from abc import ABC, abstractmethod
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn


class Fusion(nn.Module, ABC):
    """The contract: one vector (batch, width) an encoder in, context (batch, token, dim) out.

    Encoders are named `features`, `sensor`, `state`; all that `widths` named are always there, for
    a missing stream its learned embedding. The number of tokens is fixed by the constructor.
    """

    @abstractmethod
    def forward(self, encoded: Mapping[str, Tensor]) -> Float[Tensor, "batch token dim"]:
        """The context."""


class ConcatFusion(Fusion):
    """All vectors side by side through a small network, read out as `tokens` context tokens.

    Each vector is normalised first, so that none drowns the others by its scale. Several tokens,
    because attention to a single one is a constant.
    """

    def __init__(self, widths: Mapping[str, int], dim: int, tokens: int = 4) -> None:
        super().__init__()
        self.norms = nn.ModuleDict({name: nn.LayerNorm(width) for name, width in widths.items()})
        self.mix = nn.Sequential(
            nn.Linear(sum(widths.values()), dim),
            nn.GELU(approximate="tanh"),
            nn.Linear(dim, tokens * dim),
            nn.Unflatten(-1, (tokens, dim)),
            nn.LayerNorm(dim),
        )

    def forward(self, encoded: Mapping[str, Tensor]) -> Float[Tensor, "batch token dim"]:
        """The context, from the vectors in the order of the constructor's `widths`."""
        parts = [norm(encoded[name]) for name, norm in self.norms.items()]
        return self.mix(torch.cat(parts, dim=-1))


def build_fusion(strategy: str, widths: Mapping[str, int], dim: int) -> Fusion:
    """The fusion of this name for encoders of these widths."""
    kinds = {"concat": ConcatFusion}
    return kinds[strategy](widths, dim)
