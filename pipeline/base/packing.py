"""Numbers to the codes in which a store holds them, and back, on any device.

`pipeline.base.arrays` describes the dtypes. A tensor's dtype says which it is: int8, or uint8 for
float8.
"""

import torch
from jaxtyping import Float, Shaped
from torch import Tensor
from torch.nn import functional as F

from pipeline.base.arrays import BLOCK, packed_dim

_FLOAT8 = torch.float8_e4m3fn
_LARGEST_FLOAT8 = 448.0
Stored = Shaped[Tensor, "*batch _"]
"""Numbers as a store holds them; of int8 and float8, codes and then scales."""


def pack(values: Float[Tensor, "*batch dim"], dtype: str) -> Stored:
    """The numbers in a storage dtype. A NaN or an infinity reaches the scale of its codes."""
    if dtype not in ("int8", "float8"):
        return values.to(getattr(torch, dtype))
    values = values.float()
    if dtype == "float8":
        scale = (values.abs().amax(dim=-1, keepdim=True) / _LARGEST_FLOAT8).bfloat16()
        scaled = values / scale.float().clamp(min=torch.finfo(torch.float32).tiny)
        codes = scaled.clamp(-_LARGEST_FLOAT8, _LARGEST_FLOAT8).to(_FLOAT8)
        return torch.cat([codes.view(torch.uint8), _bytes(scale, torch.uint8)], dim=-1)
    dim = values.shape[-1]
    blocks = F.pad(values, (0, -dim % BLOCK)).unflatten(-1, (-1, BLOCK))
    scale = (blocks.abs().amax(dim=-1) / 127).bfloat16()
    divisor = scale.float().clamp(min=torch.finfo(torch.float32).tiny).unsqueeze(-1)
    codes = (blocks / divisor).nan_to_num(0.0).round().clamp(-127, 127).to(torch.int8)
    return torch.cat([codes.flatten(-2)[..., :dim], _bytes(scale, torch.int8)], dim=-1)


def unpack(values: Stored) -> Float[Tensor, "*batch dim"]:
    """The numbers; float dtypes stay as they are, the others become float32."""
    if values.is_floating_point():
        return values
    scale, codes = scales(values).float(), values[..., : _dim(values)]
    if values.dtype == torch.uint8:
        # Sign, exponent and mantissa where a float32 has them, 2**120 too small: on a CPU several
        # times as fast as the conversion.
        bits = codes.to(torch.int32)
        bits = ((bits & 0x80) << 24) | ((bits & 0x7F) << 20)
        return bits.view(torch.float32).mul_(2.0**120).mul_(scale)
    short = -codes.shape[-1] % BLOCK
    blocks = F.pad(codes, (0, short)).unflatten(-1, (-1, BLOCK)) * scale.unsqueeze(-1)
    return blocks.flatten(-2)[..., : codes.shape[-1]]


def scales(values: Stored) -> Stored:
    """The scales of packed numbers, finite where all numbers are; other dtypes as they are."""
    if values.is_floating_point():
        return values
    return values[..., _dim(values) :].contiguous().view(torch.bfloat16)


def _bytes(scale: Tensor, dtype: torch.dtype) -> Tensor:
    return scale.contiguous().view(dtype)


def _dim(values: Stored) -> int:
    return packed_dim(torch.empty(0, dtype=values.dtype).numpy().dtype, values.shape[-1])
