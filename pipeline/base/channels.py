"""Channels by name and unit: which are similar, and which of those hardly move."""

import re
from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

PROFILE_CHANNELS = 24
"""This many channels, or more, that differ only in a number form one profile."""
STILL = 0.01
"""A standard deviation below this share of the usual one counts as noise."""
_ALIKE = 3
"""A usual spread needs this many moving channels."""
_SHOWN = 4
_GROUP_BY_UNIT = dict.fromkeys(("m", "cm", "mm"), "translation") | {
    "deg": "rotation",
    "rad": "rotation",
}


def unnumbered(name: str) -> str:
    """The name with `#` for each number: `aline_0012` gives `aline_#`."""
    return re.sub(r"\d+", "#", name)


def named(names: Sequence[str], columns: Sequence[int]) -> str:
    """Names of channels, with neighbours as one run: `aline_0003–aline_0007, aline_0100`."""
    places = np.asarray(columns, np.int64)
    groups = np.split(places, np.flatnonzero(np.diff(places) > 1) + 1)
    ends = [(names[int(group[0])], names[int(group[-1])]) for group in groups]
    runs = [first if first == last else f"{first}–{last}" for first, last in ends]
    more = f" and {len(runs) - _SHOWN} more" if len(runs) > _SHOWN + 1 else ""
    return ", ".join(runs[:_SHOWN] if more else runs) + more


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
    """Channels that vary far less than similar ones -> the usual spread of those.

    `std` is (channel,), 0 where a channel does not vary.
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
    """For each channel the usual spread of similar ones, (channel,); 0 where there are too few.

    `std` is (channel,), 0 where a channel does not vary. Similar channels, such as joints, have the
    same unit and, apart from numbers, the same name. The usual spread is the upper quartile over
    channels that vary, so that still channels do not lower it.
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
