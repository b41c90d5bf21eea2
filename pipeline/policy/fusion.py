"""Fusions: the encoders' tokens become the context that an action expert attends to."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.policy.attention import TransformerLayer, learned
from pipeline.policy.expert import Context

Tokens = Mapping[str, Float[Tensor, "batch _ _"]]
Shapes = Mapping[str, tuple[int, int]]
"""Tokens and width of each encoder, by its name."""

_TOKENS = 4
"""Context tokens that `read_out` makes of one vector, and learned queries."""
_LAYERS = 2
"""Layers of `CrossAttentionFusion`."""
_MARK_STD = 3**-0.5
"""The std of a normalised token after a linear layer as torch initialises it."""


class Fusion(nn.Module, ABC):
    """The contract: tokens (batch, token, width) by encoder in, context (batch, token, dim) out.

    Encoders are named `features`, `sensor` and `state`; every encoder in `shapes` always gives its
    tokens, with learned embeddings for what is missing or masked. The scale of a stream does not
    let it drown another. The constructor fixes the number of context tokens.
    """

    @abstractmethod
    def forward(self, encoded: Tokens) -> Context:
        """The context."""


class StreamVectors(nn.Module):
    """One normalised vector for each stream: its tokens concatenated, so each keeps its place.

    Several tokens are projected to `dim`; a single token stays as it is. `widths` has the width of
    each vector.
    """

    def __init__(self, shapes: Shapes, dim: int) -> None:
        super().__init__()
        self.widths = {
            name: dim if tokens > 1 else width for name, (tokens, width) in shapes.items()
        }
        self.projects = nn.ModuleDict(
            {
                name: nn.Linear(tokens * width, dim)
                for name, (tokens, width) in shapes.items()
                if tokens > 1
            }
        )
        self.norms = nn.ModuleDict(
            {name: nn.LayerNorm(width) for name, width in self.widths.items()}
        )

    def forward(self, encoded: Tokens) -> dict[str, Float[Tensor, "batch _"]]:
        """The vector of each stream, in the order of the constructor's `shapes`."""
        vectors = {}
        for name, norm in self.norms.items():
            flat = encoded[name].flatten(1)
            vectors[name] = norm(self.projects[name](flat) if name in self.projects else flat)
        return vectors


class StreamTokens(nn.Module):
    """The tokens of each stream, normalised, projected to `dim` and marked.

    A mark is learned for each token, so that attention tells streams and places apart. Its initial
    std is that of the token: at the usual 0.02 a grid cell would have to learn its place.
    """

    def __init__(self, shapes: Shapes, dim: int) -> None:
        super().__init__()
        self.norms = nn.ModuleDict({n: nn.LayerNorm(width) for n, (_, width) in shapes.items()})
        self.projects = nn.ModuleDict(
            {name: nn.Linear(width, dim, bias=False) for name, (_, width) in shapes.items()}
        )
        self.marks = nn.ParameterDict(
            {
                name: nn.Parameter(torch.randn(tokens, dim) * _MARK_STD)
                for name, (tokens, _) in shapes.items()
            }
        )

    def forward(self, encoded: Tokens) -> dict[str, Float[Tensor, "batch _ dim"]]:
        """The tokens of each stream, in the order of the constructor's `shapes`."""
        return {
            name: project(self.norms[name](encoded[name])) + self.marks[name]
            for name, project in self.projects.items()
        }


def read_out(dim: int) -> nn.Sequential:
    """Several context tokens from one vector: attention to a single token is a constant."""
    return nn.Sequential(
        nn.Linear(dim, _TOKENS * dim), nn.Unflatten(-1, (_TOKENS, dim)), nn.LayerNorm(dim)
    )


class ConcatFusion(Fusion):
    """The streams' vectors, concatenated, through a small network, read out as four tokens."""

    def __init__(self, shapes: Shapes, dim: int) -> None:
        super().__init__()
        self.vectors = StreamVectors(shapes, dim)
        self.mix = nn.Sequential(
            nn.Linear(sum(self.vectors.widths.values()), dim), nn.GELU(approximate="tanh")
        )
        self.read_out = read_out(dim)

    def forward(self, encoded: Tokens) -> Context:
        """The context of four tokens."""
        return self.read_out(self.mix(torch.cat([*self.vectors(encoded).values()], dim=-1)))


class GatedFusion(Fusion):
    """A gated multimodal unit over the streams, read out as four context tokens.

    h = sum_i z_i * tanh(W_i x_i) with gates z_i = sigmoid(V_i [x_1, ..., x_n]) in (0, 1), one for
    each stream and each of the `dim` channels (Arevalo et al. 2017, "Gated Multimodal Units",
    section 3.1). A gate depends on all streams: it can shut out stale or missing vision in favour
    of the sensor, sample by sample.
    """

    def __init__(self, shapes: Shapes, dim: int) -> None:
        super().__init__()
        self.vectors = StreamVectors(shapes, dim)
        widths = self.vectors.widths
        self.content = nn.ModuleDict(
            {name: nn.Linear(width, dim) for name, width in widths.items()}
        )
        self.gate = nn.Linear(sum(widths.values()), len(widths) * dim)
        self.read_out = read_out(dim)

    def gates(
        self, vectors: Mapping[str, Float[Tensor, "batch _"]]
    ) -> dict[str, Float[Tensor, "batch dim"]]:
        """The gate of each stream, in (0, 1), by channel."""
        opened = self.gate(torch.cat([*vectors.values()], dim=-1)).float().sigmoid()
        return dict(zip(vectors, opened.chunk(len(vectors), dim=-1), strict=True))

    def forward(self, encoded: Tokens) -> Context:
        """The context of four tokens."""
        vectors = self.vectors(encoded)
        gates = self.gates(vectors)
        parts = [gates[name] * torch.tanh(self.content[name](x)) for name, x in vectors.items()]
        return self.read_out(torch.stack(parts).sum(dim=0))


class CrossAttentionFusion(Fusion):
    """Tokens of sensor and state, and learned queries, attend to the feature slots.

    In each of two layers these tokens attend to one another and then to the slots. The context is
    these tokens: four queries and each token of sensor and state. Without features they attend to
    one another alone; without sensor and state there are only the queries.
    """

    def __init__(self, shapes: Shapes, dim: int, heads: int) -> None:
        super().__init__()
        self.tokens = StreamTokens(shapes, dim)
        self.queries = learned(_TOKENS, dim)
        self.layers = nn.ModuleList(
            TransformerLayer(dim, heads, cross="features" in shapes) for _ in range(_LAYERS)
        )
        self.norm = nn.LayerNorm(dim)

    def forward(self, encoded: Tokens) -> Context:
        """The context of the queries' tokens and those of sensor and state."""
        tokens = self.tokens(encoded)
        slots = tokens.pop("features", None)
        batch = next(iter(encoded.values())).shape[0]
        asking = torch.cat([self.queries.expand(batch, -1, -1), *tokens.values()], dim=1)
        for layer in self.layers:
            asking = layer(asking, context=slots)
        return self.norm(asking)


class NoFusion(Fusion):
    """The tokens of all streams, concatenated: the expert's own attention does the rest."""

    def __init__(self, shapes: Shapes, dim: int) -> None:
        super().__init__()
        self.tokens = StreamTokens(shapes, dim)
        self.norm = nn.LayerNorm(dim)

    def forward(self, encoded: Tokens) -> Context:
        """The context, with all tokens of the encoders."""
        return self.norm(torch.cat([*self.tokens(encoded).values()], dim=1))


_FUSIONS: dict[str, Callable[[Shapes, int, int], Fusion]] = {
    "concat": lambda shapes, dim, heads: ConcatFusion(shapes, dim),
    "cross_attention": CrossAttentionFusion,
    "gated": lambda shapes, dim, heads: GatedFusion(shapes, dim),
    "none": lambda shapes, dim, heads: NoFusion(shapes, dim),
}


def build_fusion(strategy: str, shapes: Shapes, dim: int, heads: int) -> Fusion:
    """The fusion of this name for encoders of these `shapes`; its attention has `heads`."""
    return _FUSIONS[strategy](shapes, dim, heads)
