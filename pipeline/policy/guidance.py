"""Sampling a chunk that continues another (real-time chunking).

Black, Galliker and Levine 2025, "Real-Time Execution of Action Chunking Flow Policies", eq. 2 to 4:
an expert that samples is pulled, in every step, to where the clean chunk that it sees would agree
with the given one.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.policy.tensors import Chunk

MOST_GAIN = 5.0
"""beta of the paper: a few sampling steps do not bear the gains that theory gives near both ends
(appendix A.2 there)."""


@dataclass(frozen=True)
class Guide:
    """The chunk to continue, and how strongly each of its steps counts, from 0 to 1.

    What stands in a step of weight 0 changes nothing, as long as it is finite.
    """

    chunk: Chunk
    weight: Float[Tensor, "batch horizon"]

    def repeat(self, times: int) -> "Guide":
        """The guide of a batch repeated as a whole."""
        return Guide(self.chunk.repeat(times, 1, 1), self.weight.repeat(times, 1))


def pull(clean: Chunk, noisy: Chunk, guide: Guide) -> Chunk:
    """How to change the noisy chunk for the clean one, computed from it, to near the guide.

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
