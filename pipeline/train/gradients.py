"""Gradients of several processes as if one had computed them."""

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor, nn

from pipeline.train.world import World


def sum_gradients(
    world: World, parameters: Iterable[nn.Parameter], sums: Mapping[str, Tensor], stop: bool
) -> bool:
    """Replace gradients and `sums` by their sums over the processes; whether any wants to stop.

    Each process has weighted its parts by their share of the whole batch, so the sum is the mean.
    A parameter that no process used keeps no gradient, so that the optimizer leaves it alone as it
    does in a single process; one that only others used counts as zero here. All processes end with
    the same bits.
    """
    if world.size == 1:
        return stop
    parameters = list(parameters)
    used = [parameter.grad is not None for parameter in parameters]
    stop, *used = world.any([stop, *used])
    shared = [parameter for parameter, anywhere in zip(parameters, used, strict=True) if anywhere]
    for parameter in shared:
        if parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
    world.sum([*sums.values(), *(p.grad for p in shared if p.grad is not None)])
    return stop
