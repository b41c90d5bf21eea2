"""Runs of flags that hang together."""

import numpy as np
from numpy.typing import NDArray


def runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First place of each run of set flags, and one past its last.

    Where a flag stands between an entry and the next, these are a run's first and last entry.
    """
    edges = np.flatnonzero(np.diff(flags, prepend=False, append=False)).reshape(-1, 2)
    return [(int(start), int(stop)) for start, stop in edges]
