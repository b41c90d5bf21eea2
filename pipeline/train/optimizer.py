"""AdamW for the trainable parameters, its learning rates and the weight average."""

import copy
import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from pipeline.base.config import TrainHeadParams


def trainable(module: nn.Module) -> dict[str, nn.Parameter]:
    """The parameters that learn, by name."""
    return {name: value for name, value in module.named_parameters() if value.requires_grad}


def make_optimizer(
    module: nn.Module, params: TrainHeadParams, peak: Callable[[str], float | None]
) -> torch.optim.AdamW:
    """AdamW that decays matrices and kernels, but neither biases, norms nor embeddings.

    Loshchilov and Hutter, "Decoupled weight decay regularization", 2019; which parameters do not
    decay follows common practice since BERT: shrinking a gain or an offset regularises nothing.
    `peak` gives the peak learning rate of a parameter by its name; None means `params.lr`. Frozen
    parameters are left out.
    """
    learning = trainable(module)
    groups: dict[tuple[float, float], list[nn.Parameter]] = {}
    for names, decay in zip(decay_groups(module), (params.weight_decay, 0.0), strict=True):
        for name in names:
            rate = peak(name)
            rate = params.lr if rate is None else rate
            groups.setdefault((rate, decay), []).append(learning[name])
    return torch.optim.AdamW(
        [
            {"params": members, "peak_lr": rate, "lr": rate, "weight_decay": decay}
            for (rate, decay), members in groups.items()
        ],
        betas=(0.9, 0.95),
        fused=all(value.is_cuda for value in learning.values()),
    )


def decay_groups(module: nn.Module) -> tuple[list[str], list[str]]:
    """Names of the trainable parameters that are decayed, and of those that are not."""
    kernels = {
        f"{prefix}.{name}" if prefix else name
        for prefix, child in module.named_modules()
        if isinstance(child, nn.Linear | nn.Conv1d | nn.Conv2d)
        for name, parameter in child.named_parameters(recurse=False)
        if parameter.ndim >= 2
    }
    names = list(trainable(module))
    return [n for n in names if n in kernels], [n for n in names if n not in kernels]


def schedule(step: int, params: TrainHeadParams) -> float:
    """Every learning rate at a step, counted from 0, as a share of its peak.

    A linear warm-up: the first step has 1 / warmup_steps, step warmup_steps has 1. Then it falls
    along half a cosine to min_lr_fraction at the last step (Loshchilov and Hutter, "SGDR", 2017,
    eq. 5, without restarts).
    """
    warmup = min(params.warmup_steps, params.max_steps - 1)
    if step < warmup:
        return (step + 1) / warmup
    progress = (step - warmup) / max(1, params.max_steps - 1 - warmup)
    left = 0.5 * (1 + math.cos(math.pi * progress))
    return params.min_lr_fraction + (1 - params.min_lr_fraction) * left


def optimizer_tensors(optimizer: torch.optim.Optimizer, module: nn.Module) -> dict[str, Tensor]:
    """The optimizer's state as `<name of the parameter>/<entry>`."""
    names: dict[Tensor, str] = {value: name for name, value in module.named_parameters()}
    return {
        f"{names[parameter]}/{entry}": value
        for parameter, state in optimizer.state.items()
        for entry, value in state.items()
    }


def restore_optimizer(
    optimizer: torch.optim.Optimizer, module: nn.Module, tensors: Mapping[str, Tensor]
) -> None:
    """Copy the tensors of `optimizer_tensors` into a fresh optimizer over the same module."""
    parameters = dict(module.named_parameters())
    for key, value in tensors.items():
        name, _, entry = key.rpartition("/")
        parameter = parameters[name]
        # Only the moments live on the parameter's device; fused AdamW wants its step there too.
        fused = optimizer.defaults.get("fused")
        device = parameter.device if entry != "step" or fused else torch.device("cpu")
        optimizer.state[parameter][entry] = value.to(device, copy=True)


class WeightAverage:
    """A copy of a module whose weights are a moving average; the copy is evaluated and saved.

    After update t (from 1): average += (1 - d) (weights - average), d = min(decay, t / (t + 9)).
    This warm-up of Tarvainen and Valpola's mean teacher (2017), in the form of TensorFlow's
    ExponentialMovingAverage, keeps the random start out of a short run's average. Frozen parameters
    (a vision-language model's may be gigabytes) and buffers are shared with the module.
    """

    def __init__(self, module: nn.Module, decay: float) -> None:
        frozen = [value for value in module.parameters() if not value.requires_grad]
        shared = {id(value): value for value in (*frozen, *module.buffers())}
        self.module = copy.deepcopy(module, shared).requires_grad_(False).eval()
        learning = trainable(module)
        self.weights = {n: v for n, v in self.module.named_parameters() if n in learning}
        """The averaged parameters by name: those that learn in the module."""
        # Listed once: a walk through a vision-language model at every step would be slow.
        self._learning, self._averaged = tuple(learning.values()), tuple(self.weights.values())
        self._decay = decay

    @torch.no_grad()
    def update(self, updates: int) -> None:
        """Average in the module's weights after optimizer step `updates`, counted from 1."""
        decay = min(self._decay, updates / (updates + 9))
        get_ema_multi_avg_fn(decay)(self._averaged, self._learning, 0)
