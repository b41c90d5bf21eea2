"""AdamW over a policy, its learning rate, and its state as named tensors."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from pipeline.config import TrainHeadParams


def make_optimizer(policy: nn.Module, params: TrainHeadParams) -> torch.optim.AdamW:
    """AdamW that decays matrices and kernels, but neither biases, norms nor embeddings.

    (Loshchilov and Hutter, "Decoupled weight decay regularization", 2019; which parameters to
    leave out follows common practice since BERT: shrinking a gain or an offset regularises
    nothing.)
    """
    decayed, kept = decay_groups(policy)
    named = dict(policy.named_parameters())
    return torch.optim.AdamW(
        [
            {"params": [named[name] for name in decayed], "weight_decay": params.weight_decay},
            {"params": [named[name] for name in kept], "weight_decay": 0.0},
        ],
        lr=params.lr,
        betas=(0.9, 0.95),
        fused=next(policy.parameters()).is_cuda,
    )


def decay_groups(policy: nn.Module) -> tuple[list[str], list[str]]:
    """Names of the trainable parameters that are decayed, and of those that are not."""
    kernels = {
        f"{prefix}.{name}" if prefix else name
        for prefix, module in policy.named_modules()
        if isinstance(module, nn.Linear | nn.Conv1d | nn.Conv2d)
        for name, parameter in module.named_parameters(recurse=False)
        if parameter.ndim >= 2
    }
    trainable = [name for name, value in policy.named_parameters() if value.requires_grad]
    return [n for n in trainable if n in kernels], [n for n in trainable if n not in kernels]


def learning_rate(step: int, params: TrainHeadParams) -> float:
    """The rate of a step, counted from 0: linear warm-up, then half a cosine to its floor.

    The first step has lr / warmup_steps, step warmup_steps has lr, the last lr x min_lr_fraction.
    """
    warmup = min(params.warmup_steps, params.max_steps - 1)
    if step < warmup:
        return params.lr * (step + 1) / warmup
    progress = (step - warmup) / max(1, params.max_steps - 1 - warmup)
    cosine = 0.5 * (1 + math.cos(math.pi * progress))
    return params.lr * (params.min_lr_fraction + (1 - params.min_lr_fraction) * cosine)


def set_learning_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Give every group of the optimizer this rate."""
    for group in optimizer.param_groups:
        group["lr"] = rate


def optimizer_tensors(optimizer: torch.optim.Optimizer, policy: nn.Module) -> dict[str, Tensor]:
    """The optimizer's state as `<name of the parameter>/<entry>`."""
    names: dict[Tensor, str] = {value: name for name, value in policy.named_parameters()}
    return {
        f"{names[parameter]}/{entry}": value
        for parameter, state in optimizer.state.items()
        for entry, value in state.items()
    }


def restore_optimizer(
    optimizer: torch.optim.Optimizer, policy: nn.Module, tensors: Mapping[str, Tensor]
) -> None:
    """Lay the tensors of `optimizer_tensors` into a fresh optimizer over the same policy."""
    parameters = dict(policy.named_parameters())
    for key, value in tensors.items():
        name, _, entry = key.rpartition("/")
        parameter = parameters[name]
        # Only the moments live on the parameter's device; fused AdamW wants its step there too.
        fused = optimizer.defaults.get("fused")
        device = parameter.device if entry != "step" or fused else torch.device("cpu")
        optimizer.state[parameter][entry] = value.to(device, copy=True)
