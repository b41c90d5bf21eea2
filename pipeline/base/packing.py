"""Numbers to the codes in which a store holds them, and back, on any device.

`pipeline.base.arrays` describes the dtypes. A tensor's dtype says which it is: int8, or uint8 for
float8.
"""

import torch
from jaxtyping import Float, Shaped
from torch import Tensor
from torch.nn import functional as F

from pipeline.base.arrays import BLOCK, packed_dim, packed_size, scale_count

_FLOAT8 = torch.float8_e4m3fn
_LARGEST_FLOAT8 = 448.0
_NAMES = {torch.int8: "int8", torch.uint8: "float8"}
Stored = Shaped[Tensor, "*batch _"]
"""Numbers as a store holds them; of int8 and float8, codes and then scales."""


def pack(values: Float[Tensor, "*batch dim"], dtype: str) -> Stored:
    """The numbers in a storage dtype. A NaN or an infinity reaches the scale of its codes."""
    if dtype not in ("int8", "float8"):
        return values.to(getattr(torch, dtype))
    dim, tiny = values.shape[-1], torch.finfo(torch.float32).tiny
    each = BLOCK if dtype == "int8" else max(1, dim)
    blocks = F.pad(values.float(), (0, -dim % each)).unflatten(-1, (-1, each))
    most = 127.0 if dtype == "int8" else _LARGEST_FLOAT8
    scale = (blocks.abs().amax(dim=-1) / most).bfloat16()
    scaled = (blocks / scale.float().clamp(min=tiny).unsqueeze(-1)).nan_to_num(0.0)
    codes = (scaled.round() if dtype == "int8" else scaled).clamp(-most, most).flatten(-2)
    codes = codes.to(torch.int8) if dtype == "int8" else codes.to(_FLOAT8).view(torch.uint8)
    behind = scale.contiguous().view(codes.dtype)
    rest = packed_size(dtype, dim) - dim - behind.shape[-1]
    return torch.cat([codes[..., :dim], F.pad(behind, (0, rest))], dim=-1)


def unpack(values: Stored) -> Float[Tensor, "*batch dim"]:
    """The numbers; float dtypes stay as they are, the others become float32."""
    if values.is_floating_point():
        return values
    name = _NAMES[values.dtype]
    dim, scale = packed_dim(name, values.shape[-1]), scales(values).float()
    codes = values[..., :dim]
    if name == "float8":
        # Sign, exponent and mantissa where a float32 has them, 2**120 too small: on a CPU several
        # times as fast as the conversion.
        bits = codes.to(torch.int32)
        bits = ((bits & 0x80) << 24) | ((bits & 0x7F) << 20)
        return bits.view(torch.float32).mul_(2.0**120).mul_(scale)
    blocks = F.pad(codes, (0, -dim % BLOCK)).unflatten(-1, (-1, BLOCK)) * scale.unsqueeze(-1)
    return blocks.flatten(-2)[..., :dim]


def scales(values: Stored) -> Stored:
    """The scales of packed numbers, finite where all numbers are; other dtypes as they are."""
    if values.is_floating_point():
        return values
    name = _NAMES[values.dtype]
    dim = packed_dim(name, values.shape[-1])
    return values[..., dim : dim + 2 * scale_count(name, dim)].contiguous().view(torch.bfloat16)
