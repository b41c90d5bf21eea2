"""The cost of a policy: its parameters, and the arithmetic of one act."""

from copy import deepcopy

import torch
from torch import Generator
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from pipeline.policy.policy import Policy


def flop_table(policy: Policy) -> list[tuple[str, int]]:
    """The floating-point operations of one `act` at one tick, by the parts of `parameter_table`.

    It counts matrix products, convolutions and attention, a multiply-add as two, but no norms and
    activations. Windows are as long as in `train_head`. The policy and the global generators stay
    as they are.
    """
    # A frozen copy: the counter's hooks fail on views of parameters that learn.
    frozen = deepcopy(policy).requires_grad_(False).eval()
    params, shape = frozen.params, frozen.shape
    sizes = {
        "features": (shape.slots, shape.feature_dim),
        "sensor": (params.sensor_window, shape.sensor_channels),
        "state": (params.state_window, shape.state_dim),
    }
    blank = frozen.observe({name: torch.zeros(1, *size) for name, size in sizes.items()})
    generator = Generator(blank.features.device).manual_seed(0)
    # Not every device counts fused attention kernels; the plain one is counted everywhere.
    with FlopCounterMode(display=False) as counter, sdpa_kernel(SDPBackend.MATH):
        frozen.act(blank, generator)
    parts = {**dict(frozen.encoders.items()), "fusion": frozen.fusion}
    counted = counter.get_flop_counts()  # by the class of what was called
    table = [(n, sum(counted.get(type(part).__name__, {}).values())) for n, part in parts.items()]
    return [*table, ("expert", counter.get_total_flops() - sum(flops for _, flops in table))]


def describe_cost(policy: Policy) -> list[str]:
    """Two lines for the user: parameters, and FLOPs of one `act` at one tick, by part."""
    parameters, flops = policy.parameter_table(), flop_table(policy)
    counts = ", ".join(f"{name} {count:,}" for name, count in parameters)
    costs = ", ".join(f"{name} {count / 1e6:,.1f}" for name, count in flops)
    return [
        f"parameters: {sum(count for _, count in parameters):,} ({counts})",
        f"one act: {sum(count for _, count in flops) / 1e6:,.1f} MFLOP a tick ({costs})",
    ]
