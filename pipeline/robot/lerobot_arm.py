"""A robot with the interface of LeRobot's, as the control loop drives it; lerobot is not imported.

LeRobot's `Robot` (github.com/huggingface/lerobot, src/lerobot/robots/robot.py) gives one flat dict
an observation, a float a motor (`shoulder_pan.pos`) and an RGB image a camera, takes such a dict as
the action, and gives back what it really sent. `observation_features` and `action_features` name
both without a connection. It says no times: all that comes of one call is given the time at which
the call began, so that ages are rather too large than too small.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn, Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import CheckpointMismatch

_DELTA, _PLACE = "delta_", ".pos"


class LeRobotStyle(Protocol):
    """What is used of LeRobot's `Robot`."""

    @property
    def observation_features(self) -> Mapping[str, Any]: ...

    @property
    def action_features(self) -> Mapping[str, Any]: ...

    def get_observation(self) -> Mapping[str, Any]: ...

    def send_action(self, action: dict[str, Any]) -> Mapping[str, Any]: ...


class LeRobotArm:
    """A LeRobot-style robot for a policy with this metadata.

    A channel of the policy is the motor of its own name, with or without `.pos`, and of an action
    with or without a leading `delta_`, or the one that `motors` names for it; a view is the camera
    of its own name, or the one that `cameras` names. Numbers are handed through in the policy's
    units: the robot must be configured for these.
    """

    def __init__(
        self,
        robot: LeRobotStyle,
        metadata: Mapping[str, Any],
        cameras: Mapping[str, str] | None = None,
        motors: Mapping[str, str] | None = None,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """`metadata` is the policy's; `cameras` are by view, `motors` by channel.

        Raises `CheckpointMismatch`, naming both sides, where the robot lacks a motor or a camera
        of the policy's, has a motor that the policy would leave alone, or does not observe one that
        is to move by a delta; where `cameras` or `motors` name none of the policy's; and for
        velocities.
        """
        self._robot, self._clock_s = robot, clock_s
        streams, seen, moved = (
            metadata["streams"],
            robot.observation_features,
            robot.action_features,
        )
        state, action, views = streams["state"]["names"], streams["action"], streams["views"]
        if action["kind"] == "velocity":
            _refuse("places", "velocities", action["names"], moved)
        cameras, motors = cameras or {}, motors or {}
        strange = {*cameras} - {*views} | {*motors} - {*state, *action["names"]}
        if strange:
            _refuse("mappings of what it has", f"{sorted(strange)}", [*state, *views], seen)
        self._state = _matched(state, motors, seen)
        self._views = dict(zip(views, _matched(views, cameras, seen), strict=True))
        self._action = _matched(action["names"], motors, moved)
        self._moving = tuple(map(bool, metadata["moving"]))
        pairs = zip(self._action, self._moving, strict=True)
        if blind := {key for key, moving in pairs if moving} - {*seen}:
            _refuse("deltas of what is observed", f"{sorted(blind)}", action["names"], seen)
        if idle := {*moved} - {*self._action}:
            _refuse("actions for all motors", f"none for {sorted(idle)}", action["names"], moved)
        self._seen: Mapping[str, Any] = {}
        self._time_s = 0.0
        self._sent: dict[str, float] = {}

    def observe(self) -> dict[str, NDArray[Any]]:
        """Ask the robot, once a tick: `state` (1, dim), `state_time` (1,) and `time` (1,), s."""
        self._time_s = self._clock_s()
        self._seen = self._robot.get_observation()
        observed = {"time": np.array([self._clock_s()])}
        if self._state:
            state = [float(self._seen[key]) for key in self._state]
            observed["state"] = np.array([state], np.float32)
            observed["state_time"] = np.array([self._time_s])
        return observed

    def frames(self) -> dict[str, tuple[float, NDArray[np.uint8]]]:
        """By view, what came with the newest observation: its time, s, and the image, RGB."""
        seen = {view: np.asarray(self._seen[key]) for view, key in self._views.items()}
        return {view: (self._time_s, image) for view, image in seen.items()}

    def act(self, action: NDArray[np.floating[Any]]) -> None:
        """Send an action (action_dim,); what is to move is added to where it was last sent.

        The first time to where it is; and where the robot sent less, as one that clips, to that.
        """
        goal = dict(zip(self._action, map(float, action), strict=True))
        for key, moving in zip(self._action, self._moving, strict=True):
            if moving:
                goal[key] += self._sent.get(key, float(self._seen[key]))
        self._send(goal)

    def stop(self, reason: str) -> None:
        """Hold the place where the robot is; where it cannot say, that where it was last seen."""
        try:
            self._seen = self._robot.get_observation()
        finally:
            self._send({key: float(self._seen[key]) for key in self._action if key in self._seen})

    def _send(self, goal: dict[str, float]) -> None:
        sent = self._robot.send_action(dict(goal))
        self._sent = {key: float(sent.get(key, value)) for key, value in goal.items()}


def _matched(
    names: Sequence[str], given: Mapping[str, str], features: Mapping[str, Any]
) -> list[str]:
    """The robot's key for each name of the policy's."""
    keys: list[str] = []
    for name in names:
        plain = name.removeprefix(_DELTA)
        tried = [given[name]] if name in given else [name, name + _PLACE, plain, plain + _PLACE]
        if (key := next((key for key in tried if key in features), None)) is None:
            _refuse(name, f"no {' or '.join(dict.fromkeys(tried))}", names, features)
        keys.append(key)
    return keys


def _refuse(expected: str, found: str, policy: Sequence[str], robot: Mapping[str, Any]) -> NoReturn:
    raise CheckpointMismatch(
        f"LeRobotArm: the policy needs {expected}, found {found}. The policy has "
        f"{', '.join(policy)}; the robot has {', '.join(robot)}. Name what belongs together in "
        "`cameras` (view: camera) and `motors` (channel: motor)"
    )
