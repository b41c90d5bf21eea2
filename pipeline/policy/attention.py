"""Pre-norm transformer layers (Xiong et al. 2020, "On Layer Normalization in the Transformer").

`nn.TransformerEncoderLayer` switches to other kernels in evaluation and warns about masks. These
layers run the same code in training and evaluation; under autocast, norms and softmax stay in
float32.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from pipeline.base.errors import ConfigError

Tokens = Float[Tensor, "batch token dim"]
TokenMask = Bool[Tensor, "batch token"]
"""Which tokens are real."""
Projected = tuple[
    Float[Tensor, "batch head source head_dim"], Float[Tensor, "batch head source head_dim"]
]
"""Keys and values of a source, for one layer."""


class Attention(nn.Module):
    """Multi-head attention of `queries` to `source`."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        if dim % heads:
            raise ConfigError(
                f"a transformer {dim} wide cannot have {heads} heads: heads must divide the width. "
                "Change train_head.*.heads or the width beside it."
            )
        self.heads = heads
        self.query = nn.Linear(dim, dim)
        self.key_value = nn.Linear(dim, 2 * dim)
        self.out = nn.Linear(dim, dim)

    def forward(
        self,
        queries: Float[Tensor, "batch query dim"],
        source: Tokens,
        valid: TokenMask | None = None,
    ) -> Float[Tensor, "batch query dim"]:
        """The attention of each query to the valid tokens; each row must have at least one."""
        return self.attend(queries, self.project(source), valid)

    def project(self, source: Tokens) -> Projected:
        """Keys and values of a source, to attend to it more than once."""
        key, value = self.key_value(source).chunk(2, dim=-1)
        return self._split(key), self._split(value)

    def attend(
        self,
        queries: Float[Tensor, "batch query dim"],
        projected: Projected,
        valid: TokenMask | None = None,
    ) -> Float[Tensor, "batch query dim"]:
        """As `forward`, with keys and values from `project`."""
        mask = None if valid is None else valid[:, None, None, :]
        query = self._split(self.query(queries))
        taken = F.scaled_dot_product_attention(query, *projected, attn_mask=mask)
        return self.out(taken.transpose(1, 2).flatten(2))

    def _split(self, x: Tensor) -> Tensor:
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)


class TransformerLayer(nn.Module):
    """Self-attention, attention to a context where `cross`, and a feed-forward network."""

    def __init__(
        self, dim: int, heads: int, expansion: int = 4, dropout: float = 0.0, cross: bool = False
    ) -> None:
        super().__init__()
        self.self_norm = nn.LayerNorm(dim)
        self.self_attention = Attention(dim, heads)
        self.cross_norm = nn.LayerNorm(dim) if cross else None
        self.cross_attention = Attention(dim, heads) if cross else None
        self.feed_forward = nn.Sequential(
            nn.LayerNorm(dim),
            nn.Linear(dim, expansion * dim),
            nn.GELU(approximate="tanh"),
            nn.Linear(expansion * dim, dim),
        )
        self.dropout = nn.Dropout(dropout)

    def forward(
        self,
        tokens: Tokens,
        valid: TokenMask | None = None,
        context: Float[Tensor, "batch source dim"] | Projected | None = None,
        modulation: Float[Tensor, "batch 6 dim"] | None = None,
    ) -> Tokens:
        """The tokens after one layer; tokens that are not valid are never attended to.

        Where many forward passes share a context, pass this layer's `project` of it. `modulation`
        is a shift, a scale and a gate for self-attention, then for the feed-forward network (adaLN,
        Peebles & Xie 2023, figure 3); zeros change nothing.
        """
        first, second = (None, None) if modulation is None else modulation.chunk(2, dim=1)
        normed = _shifted(self.self_norm(tokens), first)
        taken = self.self_attention(normed, normed, valid)
        tokens = tokens + _gated(self.dropout(taken), first)
        if self.cross_attention is not None and self.cross_norm is not None:
            assert context is not None
            projected = self.project(context) if isinstance(context, Tensor) else context
            taken = self.cross_attention.attend(self.cross_norm(tokens), projected)
            tokens = tokens + self.dropout(taken)
        norm, *network = self.feed_forward
        normed = _shifted(norm(tokens), second)
        for module in network:
            normed = module(normed)
        return tokens + _gated(self.dropout(normed), second)

    def project(self, context: Float[Tensor, "batch source dim"]) -> Projected:
        """Keys and values that `forward` takes in place of this context."""
        assert self.cross_attention is not None
        return self.cross_attention.project(context)


def _shifted(normed: Tensor, modulation: Tensor | None) -> Tensor:
    if modulation is None:
        return normed
    shift, scale, _ = modulation.unsqueeze(2).unbind(1)
    return normed * (1 + scale) + shift


def _gated(taken: Tensor, modulation: Tensor | None) -> Tensor:
    return taken if modulation is None else taken * (1 + modulation[:, 2:])


def learned(*shape: int) -> nn.Parameter:
    """A learned embedding of this shape, drawn small (std 0.02) from the global generator."""
    return nn.Parameter(torch.randn(*shape) * 0.02)


def masked_mean(tokens: Tokens, valid: TokenMask) -> Float[Tensor, "batch dim"]:
    """The float32 mean of each row's valid tokens, 0 where it has none."""
    weight = valid.unsqueeze(-1)
    total = tokens.float().masked_fill(~weight, 0.0).sum(dim=1)
    return total / weight.sum(dim=1).clamp(min=1)


def right_aligned(valid: Tensor, window: int) -> Bool[Tensor, "batch window"]:
    """True at the last `valid[i]` steps of row i of a window; `valid` is (batch,) integer."""
    steps = torch.arange(window, device=valid.device)
    return steps >= window - valid.unsqueeze(-1)
