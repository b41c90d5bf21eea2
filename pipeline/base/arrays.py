"""Numbers that numpy does not know, as a store holds them, and a search for NaN and infinity.

bfloat16: its bits, which are the upper half of those of a float32, in uint16.

int8 and float8 (in uint8): `dim` codes, then scales as bfloat16. In int8 each 32 codes share a
scale, the largest of them / 127, as in GGML's Q8_0. In float8 (e4m3fn, Micikevicius et al. 2022)
one scale serves all, the largest number / 448. So a channel a thousand times larger than the others
costs precision in its own 32 alone, or, in float8, nowhere.
"""

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

_EXPONENTS = {"uint16": np.uint16(0x7F80), "float16": np.uint16(0x7C00)}
"""Exponent bits, which are all set only in NaN and infinity; numpy is slow with float16."""


BLOCK = 32
"""Codes of int8 that share a scale."""
SCALE_BYTES = 2
_PACKED = {"int8": BLOCK, "float8": None}
"""Codes that share a scale in each packed dtype; None: all of them."""


def packed_size(dtype: str, dim: int) -> int:
    """Entries that a store holds for `dim` numbers of a dtype."""
    if dtype not in _PACKED:
        return dim
    return dim + SCALE_BYTES * math.ceil(dim / (_PACKED[dtype] or max(1, dim)))


def packed_dim(dtype: np.dtype[Any], entries: int) -> int:
    """The numbers that a store holds in so many entries of an array's dtype."""
    if dtype == np.int8:
        return entries - SCALE_BYTES * math.ceil(entries / (BLOCK + SCALE_BYTES))
    return max(0, entries - SCALE_BYTES) if dtype == np.uint8 else entries


def widen(values: NDArray[Any]) -> NDArray[Any]:
    """The values as numbers: bits of bfloat16 and codes of int8 and float8 become float32.

    Other types stay.
    """
    if values.dtype == np.uint16:
        return (values.astype(np.uint32) << 16).view(np.float32)
    if values.dtype.name not in ("int8", "uint8"):
        return values
    dim = packed_dim(values.dtype, values.shape[-1])
    codes = values[..., :dim]
    scales = widen(np.ascontiguousarray(values[..., dim:]).view(np.uint16))
    with np.errstate(invalid="ignore"):  # 0 codes of an infinite scale
        if values.dtype == np.uint8:
            return _FLOAT8[codes] * scales
        return codes * np.repeat(scales, BLOCK, axis=-1)[..., :dim]


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
    exponent = _EXPONENTS.get(values.dtype.name)
    values = values if exponent else widen(values)
    if exponent is None:
        return ~np.isfinite(values)
    return (values.view(np.uint16) & exponent) == exponent
