"""The content of a limits file, which protects a robot from harm (`pipeline.robot.limits`)."""

from typing import Annotated, Literal

from pydantic import Field

from pipeline.base.config.section import Section

Most = dict[str, Annotated[float, Field(gt=0, le=1e12)]]


class MotionLimit(Section):
    """The largest motion, and the reaction to a larger one."""

    most: Most
    """Largest length of all `translation` or all `rotation` channels together, or largest absolute
    value of the action channel with this name."""
    on_exceed: Literal["stop", "clip"] = "stop"
    """stop: a safe stop. clip: send the longest allowed motion in the same direction."""


class Workspace(Section):
    """The space in which the robot may be."""

    box: dict[str, tuple[float, float]]
    """Lowest and highest reading for each named state channel."""


class Force(Section):
    """The largest force of the robot."""

    most: Most
    """Largest absolute reading for each named sensor channel."""


class LimitsFile(Section):
    """The content of a limits file; a missing entry is no limit."""

    step: MotionLimit | None = None
    """Limit of one action, in the units of the action."""
    speed: MotionLimit | None = None
    """Limit in units per s."""
    acceleration: MotionLimit | None = None
    """Limit in units per s²."""
    workspace: Workspace | None = None
    force: Force | None = None
