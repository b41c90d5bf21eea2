"""What diffusion and flow matching share: the network, the loss and the guidance of samples.

A guide makes a sampled chunk continue another one (real-time chunking: Black, Galliker and Levine
2025, "Real-Time Execution of Action Chunking Flow Policies", eq. 2 to 4): every sampling step is
corrected so that the clean chunk that the network predicts comes nearer to the guide's.
"""

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import cast

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from pipeline.policy.attention import Projected, TransformerLayer, learned
from pipeline.policy.expert import (
    ActionExpert,
    Chunk,
    Context,
    Generators,
    Guide,
    Losses,
    StepMask,
    standard_normal,
)

Source = Context | Sequence[Projected]
"""A context, or the result of `Denoiser.prepare` for it."""
MOST_GAIN = 5.0
"""beta of the paper: a few sampling steps do not bear the gains that theory gives near both ends
(appendix A.2 there)."""
FREQUENCIES = 64
"""Pairs of sine and cosine that encode a time."""


class Denoiser(nn.Module):
    """A transformer over the steps of a noisy chunk that attends to the context.

    The time shifts, scales and gates every layer: one network turns it into a modulation that all
    layers share, and each layer adds a learned one (adaLN-single, Chen et al. 2023, section 2.3).
    Unlike there, nothing starts at zero, so every weight learns from the first step.
    """

    frequencies: Tensor

    def __init__(
        self, *, horizon: int, action_dim: int, dim: int, layers: int, heads: int, dropout: float
    ) -> None:
        super().__init__()
        # Periods from 0.004 to 4 for times from 0 to 1, as in Black et al. 2024 (pi0).
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
        context: Source,
        valid: StepMask | None = None,
    ) -> Chunk:
        """The float32 prediction for every step of the chunk; times are in [0, 1].

        Steps that are not valid (beyond an episode's end) are never attended to, and predictions
        for them mean nothing.
        """
        if valid is not None:
            # Attention needs one token a row; a chunk without a valid step has no loss anyway.
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
        """The keys and values of the context in every layer, for a sampler of many steps."""
        return [cast(TransformerLayer, layer).project(context) for layer in self.layers]


class DrawingExpert(ActionExpert):
    """An expert that draws its chunks, and learns from `draws` noises a chunk at once.

    In training alone a linear layer, `direct`, also predicts the chunk from the context's mean, and
    half of its squared error is added to the loss: so the context soon tells what the chunk depends
    on, which noise hides at first.
    """

    stochastic = True

    def __init__(
        self,
        horizon: int,
        action_dim: int,
        dim: int,
        layers: int,
        heads: int,
        dropout: float,
        draws: int,
        groups: Sequence[str] | None,
        group_weights: Mapping[str, float] | None,
    ) -> None:
        super().__init__(horizon, action_dim, groups, group_weights, "mse")
        self.draws = draws
        self.direct = nn.Linear(dim, horizon * action_dim)
        self.denoiser = Denoiser(
            horizon=horizon, action_dim=action_dim, dim=dim, layers=layers, heads=heads,
            dropout=dropout,
        )  # fmt: skip

    def loss(
        self, context: Context, actions: Chunk, valid: StepMask, generator: Generator | None = None
    ) -> Losses:
        """The loss of `draws` noises a chunk and that of `direct`; the parts are of the noises."""
        chunk = actions.float().masked_fill(~valid.unsqueeze(-1), 0.0)
        direct = self.direct(context.mean(dim=1)).unflatten(-1, chunk.shape[1:])
        guessed = self.grouped(direct, chunk, valid)[0]
        context, chunk = (x.repeat(self.draws, 1, 1) for x in (context, chunk))
        drawn, parts = self.drawn_loss(context, chunk, valid.repeat(self.draws, 1), generator)
        return drawn + guessed / 2, parts

    @torch.no_grad()
    def act(
        self, context: Context, generator: Generators = None, guide: Guide | None = None
    ) -> Chunk:
        """A chunk drawn by the sampler, float32; with a guide, every step is corrected."""
        shape = (context.shape[0], self.horizon, self.action_dim)
        noise = standard_normal(shape, context.device, generator)
        return self.denoise(noise, self.denoiser.prepare(context), generator, guide)

    @abstractmethod
    def drawn_loss(
        self, context: Context, chunk: Chunk, valid: StepMask, generator: Generator | None
    ) -> Losses:
        """The loss of one noise a chunk; steps that are not valid are 0."""

    @abstractmethod
    def denoise(
        self, noise: Chunk, context: Source, generator: Generators, guide: Guide | None
    ) -> Chunk:
        """The chunk that the sampler makes of this noise; the generator draws what comes later."""


def pull(clean: Chunk, noisy: Chunk, guide: Guide) -> Chunk:
    """The change of the noisy chunk that brings the clean one of it nearer to the guide.

    The vector-Jacobian product (Y - clean)^T diag(W) d clean / d noisy of eq. 2.
    """
    error = guide.weight.unsqueeze(-1) * (guide.chunk - clean.detach())
    return torch.autograd.grad(clean, noisy, error)[0]


def gain(signal: float, noise: float) -> float:
    """The factor of `pull` in dx/dt where x = signal * clean + noise * epsilon.

    (signal^2 + noise^2) / (signal * noise), at most `MOST_GAIN`: the factor of eq. 2, with
    signal = tau and noise = 1 - tau there. A clean chunk is changed by `noise` times as much.
    """
    product = signal * noise
    return min(MOST_GAIN, (signal**2 + noise**2) / product) if product else MOST_GAIN
