"""An exponential moving average of a module's weights."""

import copy

import torch
from torch import nn
from torch.optim.swa_utils import get_ema_multi_avg_fn


class WeightAverage:
    """A second module whose weights trail those of a first; it is the one that is judged.

    After update t (from 1): average += (1 - d) (weights - average), d = min(decay, t / (t + 9)):
    the warm-up of Tarvainen and Valpola's mean teacher (2017) in the form of TensorFlow's
    ExponentialMovingAverage, without which a short run would still average in its random start.
    What does not learn is shared with the first, not copied: frozen parameters (those of a
    vision-language model may be gigabytes) and buffers (normalisation, group weights).
    """

    def __init__(self, module: nn.Module, decay: float) -> None:
        frozen = [value for value in module.parameters() if not value.requires_grad]
        shared = {id(value): value for value in (*frozen, *module.buffers())}
        self.module = copy.deepcopy(module, shared).requires_grad_(False).eval()
        learning = trainable(module)
        self.weights = {n: v for n, v in self.module.named_parameters() if n in learning}
        """The averaged parameters by name: those that learn in the first."""
        # At every step: a walk through a vision-language model's modules would take its time.
        self._learning, self._averaged = tuple(learning.values()), tuple(self.weights.values())
        self._decay = decay

    @torch.no_grad()
    def update(self, updates: int) -> None:
        """Take in the first's weights after the `updates`-th optimizer step, counted from 1."""
        decay = min(self._decay, updates / (updates + 9))
        get_ema_multi_avg_fn(decay)(self._averaged, self._learning, 0)


def trainable(module: nn.Module) -> dict[str, nn.Parameter]:
    """The parameters that learn, by name."""
    return {name: value for name, value in module.named_parameters() if value.requires_grad}
