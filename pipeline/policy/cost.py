"""What a policy costs: its parameters, and the arithmetic of one act."""

from collections.abc import Callable
from copy import deepcopy
from functools import partial

import torch
from torch import Generator, Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from pipeline.policy.observation import stream_validity
from pipeline.policy.policy import Policy


def flop_table(policy: Policy) -> list[tuple[str, int]]:
    """The floating-point operations of one `act` at one tick, by the parts of `parameter_table`.

    Counted are matrix products, convolutions and attention, a multiply-add as two; norms and
    activations are not. Windows are as long as `train_head` says. Neither the policy nor the global
    generators are touched.
    """
    # A frozen copy: the counter hooks every module, and views of what learns upset its hooks.
    frozen = deepcopy(policy).requires_grad_(False).eval()
    params, shape = frozen.params, frozen.shape
    sizes = {
        "features": (shape.slots, shape.feature_dim),
        "sensor": (params.sensor_window, shape.sensor_channels),
        "state": (params.state_window, shape.state_dim),
    }
    blank = frozen.observe({name: torch.zeros(1, *size) for name, size in sizes.items()})
    encoded: dict[str, Tensor] = {}
    table: list[tuple[str, int]] = []

    def count(name: str, work: Callable[[], Tensor]) -> Tensor:
        # The fused attention kernels are not counted on every device; what they replace is.
        with FlopCounterMode(display=False) as counter, sdpa_kernel(SDPBackend.MATH):
            done = work()
        table.append((name, counter.get_total_flops()))
        return done

    for name in frozen.encoders:
        valid = stream_validity(blank, name)
        encoded[name] = count(name, partial(frozen.encode, name, blank, valid))
    context = count("fusion", partial(frozen.fusion, encoded))
    generator = Generator(context.device).manual_seed(0)
    count("expert", partial(frozen.expert.act, context, generator))
    return table


def describe_cost(policy: Policy) -> list[str]:
    """Two lines for the user: parameters, and FLOPs of one `act` at one tick, by part."""
    parameters, flops = policy.parameter_table(), flop_table(policy)
    counts = ", ".join(f"{name} {count:,}" for name, count in parameters)
    costs = ", ".join(f"{name} {count / 1e6:,.1f}" for name, count in flops)
    return [
        f"parameters: {sum(count for _, count in parameters):,} ({counts})",
        f"one act: {sum(count for _, count in flops) / 1e6:,.1f} MFLOP a tick ({costs})",
    ]
