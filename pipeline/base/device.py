"""The device of tensors, and its precision.

torch is imported inside the functions: it takes over a second, which a command that has nothing to
do must not spend.
"""

from typing import TYPE_CHECKING, Literal

from pipeline.base.commands import command
from pipeline.base.errors import ConfigError

if TYPE_CHECKING:
    import torch


def resolve_device(name: str) -> "torch.device":
    """The device of a `device:` param; `auto` is the first CUDA device, or the CPU without one.

    Raises `ConfigError` for a device that this machine or this build of torch does not have.
    """
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        if device.type not in ("cpu", "cuda"):
            raise RuntimeError(f"{device.type} devices are not supported")
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(
            f"device: {name}: expected auto, cpu or a device of this machine "
            f"(CUDA devices found: {torch.cuda.device_count()}): {str(error).splitlines()[0]}. "
            f"Set device to auto or cpu, or install what {command('doctor')} says"
        ) from None
    return device


def use_bfloat16(amp: Literal["auto", "off", "bfloat16"], device: "torch.device") -> bool:
    """Whether the forward pass runs under bfloat16 autocast.

    `auto` means yes on a CUDA device with bfloat16 arithmetic. Elsewhere autocast is rarely faster,
    and float32 keeps a run reproducible to the bit.
    """
    import torch

    if amp == "auto":
        return device.type == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)
    return amp == "bfloat16"
