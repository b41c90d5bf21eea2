"""Which channels of a stream share a panel."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.base.channels import PROFILE_CHANNELS, unnumbered
from pipeline.data import Channels


@dataclass(frozen=True)
class Group:
    """Channels that one panel shows."""

    name: str
    """What their names have in common, `joint` of `joint_1` and `joint_2`; often ''."""
    unit: str
    indices: tuple[int, ...]
    names: tuple[str, ...]
    is_profile: bool
    """Whether they are one quantity over place, such as the depths of an A-scan."""

    @property
    def label(self) -> str:
        """Name and unit as an axis says them."""
        name = self.name or (self.names[0] if len(self.names) == 1 else "")
        return " ".join(part for part in (name, f"[{self.unit}]" if self.unit else "") if part)


def groups(channels: Channels, by_name: bool = True) -> list[Group]:
    """The channels grouped by unit, and by the stem of their names unless told otherwise.

    In the order in which they come; a gripper is apart, and so is a profile.
    """
    found: dict[tuple[str, str, bool], list[int]] = {}
    for index, (name, unit) in enumerate(zip(channels.names, channels.units, strict=True)):
        gripper = "gripper" in name.lower()
        stem = "gripper" if gripper else _stem(name)
        found.setdefault((stem, unit, gripper), []).append(index)
    together: dict[tuple[str, str, bool], list[int]] = {}
    for (stem, unit, gripper), indices in found.items():
        profile = len(indices) >= PROFILE_CHANNELS
        apart = by_name or gripper or profile
        together.setdefault((stem if apart else "", unit, profile), []).extend(indices)
    return [
        Group(stem, unit, tuple(indices), tuple(channels.names[i] for i in indices), profile)
        for (stem, unit, profile), indices in together.items()
    ]


def short_names(names: Sequence[str]) -> list[str]:
    """`x`, `y` of `pose_x`, `pose_y`; the names as they are where only numbers would be left."""
    stem = names[0].rpartition("_")[0] + "_"
    rest = [name.removeprefix(stem) for name in names]
    shared = len(names) > 1 and len(stem) > 1 and all(name.startswith(stem) for name in names)
    return list(names) if not shared or any(one.isdigit() for one in rest) else rest


def _stem(name: str) -> str:
    """`joint` of `joint_1`, `pose` of `pose_x`, `joint_vel` of `joint_1_vel`; else ''."""
    numbered = unnumbered(name)
    if numbered != name:
        return numbered.replace("_#", "").replace("#", "")
    lettered = re.fullmatch(r"(.+)_[a-z]", name)
    return lettered[1] if lettered else ""
