"""How far recomputed features are from the stored ones, and how far they may be."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Largest deviation of a number, relative to the root mean square of its slot, by the coarser of
# compute and storage dtype.
#
# Measured with the demo checkpoint on a CPU, against batches of 8 on one thread: batches of 1 and
# 3, two threads and eager attention move a number of 16 rows x 49 slots x 128 by at most 7e-6 in
# float32, 0.012 in float16 and 0.070 in bfloat16 (two of its steps after four layers). Deeper
# models deviate more, so a few times that is allowed, and in float32, where that is still small, a
# hundred times, because GPUs sum in other orders. A real fault deviates far more: another frame,
# prompt or weight changes numbers by about their own size.
TOLERANCES = {"float32": 1e-3, "float16": 5e-2, "bfloat16": 3e-1}


def tolerance_of(spec: Mapping[str, Any]) -> float:
    """The tolerance for features of this spec, relative to the root mean square of a slot."""
    return max(TOLERANCES[spec[dtype]] for dtype in ("compute_dtype", "storage_dtype"))


@dataclass(frozen=True)
class SlotDeviations:
    """The largest deviation of each slot of a row, (slot,): absolute, and `relative` to the root
    mean square of the stored slot; infinite or NaN where features are not finite."""

    absolute: NDArray[np.float64]
    relative: NDArray[np.float64]

    @property
    def worst(self) -> int:
        """The slot that deviates most."""
        return int(np.argmax(np.nan_to_num(self.relative, nan=np.inf)))

    def beyond(self, tolerance: float) -> list[int]:
        """The slots that deviate more, the worst first; includes every NaN."""
        order = np.argsort(-np.nan_to_num(self.relative, nan=np.inf), kind="stable")
        return [int(slot) for slot in order if not self.relative[slot] <= tolerance]


def slot_deviations(stored: NDArray[Any], today: NDArray[Any]) -> SlotDeviations:
    """The deviations of a row's features (slot, dim)."""
    numbers = stored.astype(np.float64)
    apart = np.abs(today.astype(np.float64) - numbers).max(axis=-1)
    rms = np.sqrt(np.mean(numbers**2, axis=-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(apart == 0, 0.0, apart / rms)  # a slot of zeros has no deviation
    return SlotDeviations(apart, relative)
