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
_GROUP_BY_UNIT = dict.fromkeys(("m", "cm", "mm"), "translation") | {
    "deg": "rotation",
    "rad": "rotation",
}


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


def action_groups(names: Sequence[str], units: Sequence[str]) -> tuple[str, ...]:
    """The loss group of each action channel, by its name (gripper) and then by its unit.

    Lengths are translation and angles rotation; velocities and unnamed quantities are other.
    """
    return tuple(
        "gripper" if "gripper" in name.lower() else _GROUP_BY_UNIT.get(unit.lower(), "other")
        for name, unit in zip(names, units, strict=True)
    )


def hardly_moving(
    std: NDArray[np.floating], names: Sequence[str], units: Sequence[str]
) -> dict[int, float]:
    """Channels that vary, but far less than those alike; each with what is usual for these.

    `std` is (channel,), 0 where one does not vary.
    """
    usual = usual_spread(std, names, units)
    return {
        column: float(usual[column])
        for column in np.flatnonzero(std > 0).tolist()
        if std[column] < STILL * usual[column]
    }


def usual_spread(
    std: NDArray[np.floating], names: Sequence[str], units: Sequence[str]
) -> NDArray[np.float64]:
    """What is usual for the channels that are like each, (channel,); 0 where too few are.

    `std` is (channel,), 0 where one does not vary. Alike are channels of one unit and, but for its
    numbers, one name, such as joints; usual is the upper quartile of those that vary, which still
    channels beside moving ones do not lower.
    """
    kinds: dict[tuple[str, str], list[int]] = defaultdict(list)
    for column, kind in enumerate(zip(map(unnumbered, names), units, strict=True)):
        kinds[kind].append(column)
    usual = np.zeros(len(std))
    for alike in kinds.values():
        moving = std[alike][std[alike] > 0]
        if len(moving) >= _ALIKE:
            usual[alike] = np.percentile(moving, 75, method="higher")
    return usual
