"""Numbers that numpy does not know, as a store holds them, and a search for NaN and infinity.

bfloat16: its bits, which are the upper half of those of a float32, in uint16.

int8 and float8 (in uint8): `dim` codes, then scales as bfloat16, then zeros up to a multiple that
lets few rows fill whole pages. In int8 each 32 codes share a scale, the largest of them / 127, as
in GGML's Q8_0. In float8 (e4m3fn, Micikevicius et al. 2022) one scale serves all, the largest
number / 448. So a channel a thousand times larger than the others costs precision in its own 32
alone, or, in float8, nowhere.
"""

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

_EXPONENTS = {"uint16": np.uint16(0x7F80), "float16": np.uint16(0x7C00)}
"""Exponent bits, which are all set only in NaN and infinity; numpy is slow with float16."""


BLOCK = 32
"""Codes of int8 that share a scale."""
_SCALE_BYTES = 2
PACKED = {"int8": "int8", "float8": "uint8"}
"""The numpy dtype of each packed one."""


def scale_count(dtype: str, dim: int) -> int:
    """Scales of `dim` numbers in int8 or float8."""
    return math.ceil(dim / BLOCK) if dtype == "int8" else min(dim, 1)


def packed_size(dtype: str, dim: int) -> int:
    """Entries that a store holds for `dim` numbers of a dtype."""
    if dtype not in PACKED:
        return dim
    multiple = 2 ** max(0, (dim // 16).bit_length() - 1)  # so zeros take at most a sixteenth
    return dim + math.ceil(_SCALE_BYTES * scale_count(dtype, dim) / multiple) * multiple


@lru_cache
def packed_dim(dtype: str, entries: int) -> int:
    """The numbers that a store holds in so many entries of int8 or float8; else the entries."""
    if dtype not in PACKED:
        return entries
    fitting = (dim for dim in range(entries, -1, -1) if packed_size(dtype, dim) <= entries)
    return next(fitting, 0)


def _packed(values: NDArray[Any]) -> str | None:
    """The packed dtype of an array's values; None for plain ones."""
    return {held: dtype for dtype, held in PACKED.items()}.get(values.dtype.name)


def dim_of(values: NDArray[Any]) -> int:
    """The numbers along the last axis of values as a store holds them."""
    return packed_dim(_packed(values) or "", values.shape[-1])


def _scales(values: NDArray[Any], dtype: str) -> NDArray[np.uint16]:
    """The bits of the scales of packed values."""
    dim = dim_of(values)
    stop = dim + _SCALE_BYTES * scale_count(dtype, dim)
    return np.ascontiguousarray(values[..., dim:stop]).view(np.uint16)


def _spread(of_scales: NDArray[Any], dtype: str, dim: int) -> NDArray[Any]:
    """What holds for a scale, for each of its numbers."""
    each = BLOCK if dtype == "int8" else dim
    return np.repeat(of_scales, each, axis=-1)[..., :dim]


def widen(values: NDArray[Any]) -> NDArray[Any]:
    """The values as numbers: bits of bfloat16 and codes of int8 and float8 become float32.

    Other types stay.
    """
    if values.dtype == np.uint16:
        return (values.astype(np.uint32) << 16).view(np.float32)
    if (dtype := _packed(values)) is None:
        return values
    dim, scales = dim_of(values), widen(_scales(values, dtype))
    codes = values[..., :dim] if dtype == "int8" else _FLOAT8[values[..., :dim]]
    with np.errstate(invalid="ignore", over="ignore"):  # of an infinite scale
        return codes * _spread(scales, dtype, dim)


def code_size(values: NDArray[Any]) -> NDArray[Any] | float:
    """How far apart two neighbouring codes of packed values are, at each number; 0 of others."""
    if (dtype := _packed(values)) is None:
        return 0.0
    if dtype == "float8":
        return np.abs(widen(values)) / 8
    return _spread(widen(_scales(values, dtype)), dtype, dim_of(values))


def _float8() -> NDArray[np.float32]:
    """The number of each code of e4m3fn: a sign, four bits of exponent, three of mantissa."""
    code = np.arange(128)
    exponent, mantissa = code >> 3, code & 7
    numbers = np.where(exponent == 0, mantissa * 2.0**-9, (8 + mantissa) * 2.0 ** (exponent - 10.0))
    numbers[-1] = np.nan
    return np.concatenate([numbers, -numbers]).astype(np.float32)


_FLOAT8 = _float8()


def array_of(tensor: "Tensor") -> NDArray[Any]:
    """The tensor as a store holds it, on the CPU: bfloat16 becomes uint16 bits."""
    import torch

    bits = tensor.view(torch.uint16) if tensor.dtype == torch.bfloat16 else tensor
    return bits.cpu().numpy()


def first_non_finite(
    values: NDArray[Any], valid: NDArray[np.bool_] | None = None
) -> tuple[int, ...] | None:
    """The index of the first NaN or infinity, in C order; None where there is none.

    `valid` has the shape of the leading axes of `values`; other entries are ignored. Values are
    read as a store holds them.
    """
    bad = non_finite(values)
    if valid is not None:
        bad &= valid.reshape(valid.shape + (1,) * (values.ndim - valid.ndim))
    if not bad.any():
        return None
    return tuple(int(index) for index in np.unravel_index(int(bad.argmax()), bad.shape))


def non_finite(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether each value is NaN or infinite; values are read as a store holds them."""
    if (dtype := _packed(values)) is not None:
        bad = _spread(non_finite(_scales(values, dtype)), dtype, dim_of(values))
        return bad | ((values[..., : bad.shape[-1]] & 0x7F) == 0x7F) if dtype == "float8" else bad
    exponent = _EXPONENTS.get(values.dtype.name)
    if exponent is None:
        return ~np.isfinite(values)
    return (values.view(np.uint16) & exponent) == exponent
