"""AdamW over what learns, its learning rates, and its state as named tensors."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from pipeline.base.config import TrainHeadParams
from pipeline.train.ema import trainable
from pipeline.train.feature_source import FeatureSource


def make_optimizer(
    module: nn.Module, params: TrainHeadParams, peaks: Mapping[str, float]
) -> torch.optim.AdamW:
    """AdamW that decays matrices and kernels, but neither biases, norms nor embeddings.

    (Loshchilov and Hutter, "Decoupled weight decay regularization", 2019; which parameters to
    leave out follows common practice since BERT: shrinking a gain or an offset regularises
    nothing.) `peaks` has the peak learning rate of each parameter by name; one that is not named
    has `params.lr`. Frozen parameters are left out.
    """
    learning = trainable(module)
    groups: dict[tuple[float, float], list[nn.Parameter]] = {}
    for names, decay in zip(decay_groups(module), (params.weight_decay, 0.0), strict=True):
        for name in names:
            groups.setdefault((peaks.get(name, params.lr), decay), []).append(learning[name])
    return torch.optim.AdamW(
        [
            {"params": members, "peak_lr": peak, "lr": peak, "weight_decay": decay}
            for (peak, decay), members in groups.items()
        ],
        betas=(0.9, 0.95),
        fused=all(value.is_cuda for value in learning.values()),
    )


def peak_rates(
    module: nn.Module, front: FeatureSource, params: TrainHeadParams
) -> dict[str, float]:
    """The peak learning rate of each parameter that does not have `params.lr`, by name.

    The front's word comes first, then `sensor_lr` for the sensor encoder.
    """
    encoders = front.policy_of(module).encoders
    sensor = encoders["sensor"].parameters() if "sensor" in encoders else ()
    felt = {id(parameter) for parameter in sensor}
    peaks = {}
    for name, parameter in trainable(module).items():
        rate = front.parameter_lr(name)
        if rate is None and id(parameter) in felt:
            rate = params.sensor_lr
        if rate is not None:
            peaks[name] = rate
    return peaks


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
    """The share of its peak that every learning rate has at a step, counted from 0.

    A linear warm-up: the first step has 1 / warmup_steps, step warmup_steps has 1. Then `cosine`
    falls along half a cosine to min_lr_fraction at the last step (Loshchilov and Hutter, "SGDR",
    2017, eq. 5, without restarts), `trapezoid` stays at 1 and falls linearly to it over the last
    decay_fraction of all steps (warmup-stable-decay: Hu et al., "MiniCPM", 2024), and `constant`
    stays at 1.
    """
    warmup = min(params.warmup_steps, params.max_steps - 1)
    if step < warmup:
        return (step + 1) / warmup
    if params.lr_schedule == "constant":
        return 1.0
    last = params.max_steps - 1
    begin = warmup
    if params.lr_schedule == "trapezoid":
        begin = max(warmup, last - round(params.decay_fraction * params.max_steps))
    progress = max(0, step - begin) / max(1, last - begin)
    left = 1 - progress
    if params.lr_schedule == "cosine":
        left = 0.5 * (1 + math.cos(math.pi * progress))
    return params.min_lr_fraction + (1 - params.min_lr_fraction) * left


def set_learning_rates(optimizer: torch.optim.Optimizer, share: float) -> None:
    """Give every group of the optimizer this share of its peak."""
    for group in optimizer.param_groups:
        group["lr"] = group["peak_lr"] * share


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
    """Lay the tensors of `optimizer_tensors` into a fresh optimizer over the same module."""
    parameters = dict(module.named_parameters())
    for key, value in tensors.items():
        name, _, entry = key.rpartition("/")
        parameter = parameters[name]
        # Only the moments live on the parameter's device; fused AdamW wants its step there too.
        fused = optimizer.defaults.get("fused")
        device = parameter.device if entry != "step" or fused else torch.device("cpu")
        optimizer.state[parameter][entry] = value.to(device, copy=True)
