"""What an environment has to have so that a policy can be rolled out in it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import ConfigError
from pipeline.data.recording import ActionKind, Channels

Readings = dict[str, NDArray[Any]]
Shots = Mapping[str, tuple[float, NDArray[np.uint8]]]
"""By view: the capture time of its newest frame in s, and the frame (height, width, 3), RGB."""
Action = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class EnvironmentRobot:
    """What a policy must fit: streams, actions and views, as in the recordings of this robot."""

    name: str
    """As `rollout.environment` has it."""
    level: str
    """What tables call its episodes: a task, or how hard it is."""
    instruction: str
    """The prompt of the policy."""
    hz: float
    """Control steps in a second."""
    action: Channels
    action_kind: ActionKind
    views: tuple[str, ...]
    state: Channels | None = None
    sensor: Channels | None = None

    @property
    def streams(self) -> dict[str, Channels | None]:
        """The channels of each stream; None for a stream that the robot does not have."""
        return {"action": self.action, "state": self.state, "sensor": self.sensor}


class RobotEnvironment(gymnasium.Env[Any, Action], ABC):
    """A simulated robot: gymnasium's `reset` and `step`, its cameras, and what a policy must fit.

    An observation has the keys of the policy server: `state` (reading, channel) and `state_time`
    (reading,), likewise `sensor` where the robot has one, all readings of the tick that ends now;
    `time` (1,), all times in s since the episode began. After the last step `info["success"]` says
    whether the task is done, and `info["reason"]`, in words, how the episode ended. The same seed
    and actions give the same episode, whatever was played before.
    """

    robot: EnvironmentRobot
    draws_in_threads: ClassVar[bool] = False
    """Whether several environments may draw their frames at the same time, in threads."""

    @abstractmethod
    def frames(self) -> Shots:
        """The newest frame of each view."""

    def frame_times(self) -> Mapping[str, float]:
        """When the newest frame of each view was taken, in s."""
        return {view: time_s for view, (time_s, _) in self.frames().items()}

    def still(self) -> Action:
        """The action (channel,) that moves nothing, until the policy's first one has come.

        Raises `ConfigError` for absolute actions, for which no action is known to move nothing.
        """
        if self.robot.action_kind == "absolute":
            raise ConfigError(
                f"rollout.environment: {self.robot.name}: its actions are absolute, so its class "
                "must have a method `still` that gives the action which moves nothing"
            )
        return np.zeros(len(self.robot.action.names))

    def expert_action(self) -> Action | None:
        """The next action of the environment's own demonstrator; None where it has none."""
        return None

    def figures(self) -> Mapping[str, float]:
        """What to say of the episode that has ended, by names with units.

        Summaries show the first of them.
        """
        return {}
