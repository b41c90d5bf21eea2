"""Channels by name: which are alike, and which of these hardly move."""

import re
from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

PROFILE_CHANNELS = 24
"""Channels of one unit that a number alone tells apart, from which they are one profile."""
STILL = 0.01
"""Times what is usual for channels alike, below which a standard deviation is that of noise."""
_ALIKE = 3
"""Moving channels alike, from which what is usual for them is known."""
_SHOWN = 4


def unnumbered(name: str) -> str:
    """The name with `#` for each number: `aline_#` of `aline_0012`; the same without a number."""
    return re.sub(r"\d+", "#", name)


def named(names: Sequence[str], columns: Sequence[int]) -> str:
    """Channels by name, neighbours as one run: `aline_0003–aline_0007, aline_0100`."""
    places = np.asarray(columns, np.int64)
    groups = np.split(places, np.flatnonzero(np.diff(places) > 1) + 1)
    ends = [(names[int(group[0])], names[int(group[-1])]) for group in groups]
    said = [first if first == last else f"{first}–{last}" for first, last in ends]
    more = f" and {len(said) - _SHOWN} more" if len(said) > _SHOWN + 1 else ""
    return ", ".join(said[:_SHOWN] if more else said) + more


def hardly_moving(
    std: NDArray[np.floating], names: Sequence[str], units: Sequence[str]
) -> dict[int, float]:
    """Channels that vary, but far less than those alike; each with what is usual for these.

    `std` is (channel,), 0 where one does not vary. Alike are channels of one unit and, but for its
    numbers, one name, such as joints; usual is the upper quartile of their `std`, which still
    channels beside moving ones do not lower.
    """
    kinds: dict[tuple[str, str], list[int]] = defaultdict(list)
    for column in np.flatnonzero(std > 0).tolist():
        kinds[unnumbered(names[column]), units[column]].append(column)
    usual = {
        column: float(np.percentile(std[alike], 75, method="higher"))
        for alike in kinds.values()
        if len(alike) >= _ALIKE
        for column in alike
    }
    return {
        column: usual[column] for column in sorted(usual) if std[column] < STILL * usual[column]
    }
