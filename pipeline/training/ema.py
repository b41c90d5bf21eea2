"""An exponential moving average of a policy's weights."""

import copy
from typing import Generic, TypeVar

import torch
from torch import nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

Module = TypeVar("Module", bound=nn.Module)


class WeightAverage(Generic[Module]):
    """A second policy whose weights trail those of the first; it is the one that is judged.

    After update t (from 1): average += (1 - d) (weights - average), d = min(decay, t / (t + 9)):
    the warm-up of Tarvainen and Valpola's mean teacher (2017) in the form of TensorFlow's
    ExponentialMovingAverage, without which a short run would still average in its random start.
    Buffers stay those of the first: a policy's (normalisation, group weights) never change.
    """

    def __init__(self, policy: Module, decay: float) -> None:
        self.policy = copy.deepcopy(policy).requires_grad_(False)
        self.policy.eval()
        self._decay = decay

    @torch.no_grad()
    def update(self, policy: Module, updates: int) -> None:
        """Take in the weights after the `updates`-th optimizer step, counted from 1."""
        decay = min(self._decay, updates / (updates + 9))
        average = tuple(self.policy.parameters())
        get_ema_multi_avg_fn(decay)(average, tuple(policy.parameters()), 0)
