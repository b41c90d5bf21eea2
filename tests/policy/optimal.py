"""Experts with the best possible network: that of chunks whose distribution is known."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from pipeline.policy.expert import ActionExpert


@dataclass(frozen=True)
class Mixture:
    """Round Gaussians of one spread: `means` (mode, dim), `weights` (mode,); sums to 1.

    Chunks are of a single step.
    """

    means: Tensor
    weights: Tensor
    spread: float

    @property
    def size(self) -> tuple[int, int]:
        """Steps and channels of a chunk."""
        return 1, self.means.shape[1]

    def draw(self, count: int, generator: torch.Generator | None = None) -> Tensor:
        """(count, 1, dim) chunks."""
        mode = torch.multinomial(self.weights, count, replacement=True, generator=generator)
        noise = torch.randn(count, self.means.shape[1], generator=generator)
        return (self.means[mode] + self.spread * noise).unsqueeze(1)

    def expectations(self, noisy: Tensor, signal: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """What is left of sample and noise on average, given signal * sample + noise * epsilon."""
        signal, noise = (x.view(-1, 1, 1).to(noisy) for x in (signal, noise))
        variance = (signal * self.spread) ** 2 + noise**2
        off = noisy - signal * self.means.to(noisy)
        likelihood = self.weights.to(noisy).log() - (off**2).sum(-1) / (2 * variance.squeeze(-1))
        share = likelihood.softmax(-1).unsqueeze(-1)
        sample = self.means.to(noisy) + signal * self.spread**2 / variance * off
        epsilon = noise / variance * off
        return tuple((share * x).sum(1, keepdim=True) for x in (sample, epsilon))  # type: ignore


TWO_MODES = Mixture(torch.tensor([[-1.0, 0.5], [1.0, -0.5]]), torch.tensor([0.3, 0.7]), 0.1)
"""In 2-D, of unequal weight, far apart for their spread."""


class Optimal(nn.Module):
    """What the best network of an expert says; counts how often it is asked."""

    def __init__(self, expert: Any, known: Any) -> None:
        super().__init__()
        self.schedule = getattr(expert, "schedule", None)  # of diffusion alone
        self.prediction = getattr(expert, "prediction", None)
        self.known, self.asked = known, 0

    def prepare(self, context: Tensor) -> Tensor:
        return context

    def forward(self, noisy: Tensor, time: Tensor, context: Tensor, valid: Any = None) -> Tensor:
        self.asked += 1
        if self.schedule is None:  # the velocity on straight paths
            sample, noise = self.known.expectations(noisy.double(), time, 1 - time)
            return (sample - noise).float()
        step = (time * self.schedule.timesteps).round().long()
        signal, noise = self.schedule.signal[step], self.schedule.noise[step]
        sample, epsilon = self.known.expectations(noisy.double(), signal, noise)
        return self.schedule.target(self.prediction, sample, epsilon, step).float()


def optimal(kind: type[ActionExpert], known: Any, **arguments: Any) -> Any:
    """An expert of chunks of a known distribution (`size`, `expectations`)."""
    horizon, width = known.size
    expert: Any = kind(horizon=horizon, action_dim=width, dim=8, layers=1, heads=1, **arguments)
    expert.denoiser = Optimal(expert, known)
    return expert


def drawn(expert: ActionExpert, count: int = 4000) -> Tensor:
    return expert.act(torch.zeros(count, 1, 8), torch.Generator().manual_seed(0))
