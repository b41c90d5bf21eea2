"""The content of a file of limits, which keep a robot from harm (`pipeline.robot.limits`)."""

from typing import Annotated, Literal

from pydantic import Field

from pipeline.base.config.section import Section

Most = dict[str, Annotated[float, Field(gt=0, le=1e12)]]


class MotionLimit(Section):
    """The largest motion, and the reaction to a larger one."""

    most: Most
    """By `translation` or `rotation`, the length of these channels together, or by the name of an
    action's channel, its size."""
    on_exceed: Literal["stop", "clip"] = "stop"
    """stop: a safe stop. clip: the longest that is allowed is sent, in the same direction."""


class Workspace(Section):
    """The space in which the robot may be."""

    box: dict[str, tuple[float, float]]
    """Lowest and highest reading by the name of a state's channel."""


class Force(Section):
    """The largest force of the robot."""

    most: Most
    """Largest size of a reading by the name of a sensor's channel."""


class LimitsFile(Section):
    """The content of a limits file; a missing entry is no limit."""

    step: MotionLimit | None = None
    """Of one action, in the units of the action."""
    speed: MotionLimit | None = None
    """Units per s."""
    acceleration: MotionLimit | None = None
    """Units per s²."""
    workspace: Workspace | None = None
    force: Force | None = None
