"""Arrays of bfloat16, held as bits in uint16, and a search for NaN and infinity.

numpy and zarr do not know bfloat16. Its bits are the upper half of those of a float32.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

_EXPONENTS = {"uint16": np.uint16(0x7F80), "float16": np.uint16(0x7C00)}
"""Exponent bits, which are all set only in NaN and infinity; numpy is slow with float16."""


def widen(values: NDArray[Any]) -> NDArray[Any]:
    """The values as numbers: uint16 (bfloat16 bits) becomes float32, other types stay."""
    if values.dtype != np.uint16:
        return values
    return (values.astype(np.uint32) << 16).view(np.float32)


def array_of(tensor: "Tensor") -> NDArray[Any]:
    """The tensor as a store holds it, on the CPU: bfloat16 becomes uint16 bits."""
    import torch

    bits = tensor.view(torch.uint16) if tensor.dtype == torch.bfloat16 else tensor
    return bits.cpu().numpy()


def first_non_finite(
    values: NDArray[Any], valid: NDArray[np.bool_] | None = None
) -> tuple[int, ...] | None:
    """The index of the first NaN or infinity, in C order; None where there is none.

    `valid` has the shape of the leading axes of `values`; other entries are ignored. A uint16 array
    is read as the bits of bfloat16.
    """
    bad = non_finite(values)
    if valid is not None:
        bad &= valid.reshape(valid.shape + (1,) * (values.ndim - valid.ndim))
    if not bad.any():
        return None
    return tuple(int(index) for index in np.unravel_index(int(bad.argmax()), bad.shape))


def non_finite(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether each value is NaN or infinite; a uint16 array is read as the bits of bfloat16."""
    exponent = _EXPONENTS.get(values.dtype.name)
    if exponent is None:
        return ~np.isfinite(values)
    return (values.view(np.uint16) & exponent) == exponent
