"""The action expert that predicts the chunk directly."""

from collections.abc import Mapping, Sequence

from torch import Generator, nn

from pipeline.policy.attention import TransformerLayer, learned
from pipeline.policy.expert import ActionExpert, Chunk, Context, Generators, Guide, Losses, StepMask


class RegressionActionExpert(ActionExpert):
    """A transformer decoder from learned queries, one a step of the horizon.

    `predict` takes the context and nothing else, and both `loss` and `act` use it, so a target
    cannot become an input.
    """

    stochastic = False

    def __init__(
        self,
        *,
        horizon: int = 8,
        action_dim: int = 7,
        dim: int = 512,
        layers: int = 4,
        heads: int = 8,
        dropout: float = 0.1,
        groups: Sequence[str] | None = None,
        group_weights: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(horizon, action_dim, groups, group_weights, "smooth_l1")
        self.queries = learned(horizon, dim)
        self.layers = nn.ModuleList(
            TransformerLayer(dim, heads, dropout=dropout, cross=True) for _ in range(layers)
        )
        self.norm = nn.LayerNorm(dim)
        self.head = nn.Linear(dim, action_dim)
        nn.init.normal_(self.head.weight, std=0.02)
        nn.init.zeros_(self.head.bias)

    def predict(self, context: Context) -> Chunk:
        """The chunk in normalised units, float32."""
        tokens = self.queries.expand(context.shape[0], -1, -1)
        for layer in self.layers:
            tokens = layer(tokens, context=context)
        return self.head(self.norm(tokens)).float()

    def loss(
        self, context: Context, actions: Chunk, valid: StepMask, generator: Generator | None = None
    ) -> Losses:
        """The grouped smooth-L1 of `predict(context)`; `generator` is not needed."""
        return self.grouped(self.predict(context), actions, valid)

    def act(
        self, context: Context, generator: Generators = None, guide: Guide | None = None
    ) -> Chunk:
        """`predict(context)`; `generator` is not needed, and there is nothing to guide."""
        assert guide is None, "an expert that draws nothing cannot be guided"
        return self.predict(context)
