"""bfloat16 as numpy arrays hold it: its bits as uint16, for neither numpy nor zarr knows the type.

The bits are the upper half of a float32's.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor


def widen(values: NDArray[Any]) -> NDArray[Any]:
    """The numbers: uint16 bits become float32, other types stay as they are."""
    if values.dtype != np.uint16:
        return values
    return (values.astype(np.uint32) << 16).view(np.float32)


def array_of(tensor: "Tensor") -> NDArray[Any]:
    """The tensor, on the CPU, as a store holds it: bfloat16 becomes its bits as uint16."""
    import torch

    bits = tensor.view(torch.uint16) if tensor.dtype == torch.bfloat16 else tensor
    return bits.cpu().numpy()
