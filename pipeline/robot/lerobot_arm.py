"""Drives a robot with LeRobot's interface from the control loop; lerobot is not imported.

LeRobot's `Robot` (github.com/huggingface/lerobot, src/lerobot/robots/robot.py) returns an
observation as one flat dict with a float for each motor (`shoulder_pan.pos`) and an RGB image for
each camera. It takes such a dict as the action, and returns the action that it really sent.
`observation_features` and `action_features` list the keys of both without a connection.

It gives no times. Motors are read during a call, so readings get the time at which the call began.
Cameras take images on threads of their own, so an image is older, by up to its camera's period: set
`camera_latency_s`, or frames and features seem that much younger than they are.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import CheckpointMismatch

_DELTA, _PLACE = "delta_", ".pos"


class LeRobotArm:
    """A LeRobot-style robot for a policy with this metadata.

    A channel of the policy belongs to the motor of the same name, where a leading `delta_` and a
    final `.pos` make no difference, or to the motor that `motors` names for it. A view belongs to
    the camera of the same name, or to the one that `cameras` names. Numbers are passed on
    unchanged: configure the robot for the policy's units.
    """

    def __init__(
        self,
        robot: Any,
        metadata: Mapping[str, Any],
        cameras: Mapping[str, str] | None = None,
        motors: Mapping[str, str] | None = None,
        clock_s: Callable[[], float] = time.monotonic,
        camera_latency_s: float = 0.0,
    ) -> None:
        """`metadata` is the policy's; `cameras` are by view, `motors` by channel.

        Raises `CheckpointMismatch`, which names both sides, where the robot lacks a motor or camera
        of the policy, has a motor that the policy does not move, or does not observe a motor that
        moves by deltas; where `cameras` or `motors` name something that the policy does not have;
        and for actions that are neither absolute nor deltas.
        """
        self._robot, self._clock_s = robot, clock_s
        self._camera_latency_s = camera_latency_s
        streams, seen, moved = (
            metadata["streams"],
            robot.observation_features,
            robot.action_features,
        )
        state, action, views = streams["state"]["names"], streams["action"], streams["views"]
        if action["kind"] not in ("absolute", "delta"):
            _refuse(f"actions that are {action['kind']}", "places", action["names"], moved)
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
        """Observe once a tick: `state` (1, dim), `state_time` (1,) and `time` (1,), s."""
        self._time_s = self._clock_s()
        self._seen = self._robot.get_observation()
        observed = {"time": np.array([self._clock_s()])}
        if self._state:
            state = [float(self._seen[key]) for key in self._state]
            observed["state"] = np.array([state], np.float32)
            observed["state_time"] = np.array([self._time_s])
        return observed

    def frames(self) -> dict[str, tuple[float, NDArray[np.uint8]]]:
        """The frames of the newest observation by view: capture time in s, and RGB image."""
        taken_s = self._time_s - self._camera_latency_s
        return {view: (taken_s, np.asarray(self._seen[key])) for view, key in self._views.items()}

    def act(self, action: NDArray[np.floating[Any]]) -> None:
        """Send an action (action_dim,); a delta is added to the motor's last goal.

        The first delta is added to the motor's position. If the robot clips a goal, the goal that
        it returns counts.
        """
        goal = dict(zip(self._action, map(float, action), strict=True))
        for key, moving in zip(self._action, self._moving, strict=True):
            if moving:
                goal[key] += self._sent.get(key, float(self._seen[key]))
        self._send(goal)

    def stop(self, reason: str) -> None:
        """Hold the position of the newest observation; observing again might block.

        It may be called from any thread. If another call has the robot's port, LeRobot refuses this
        one; the loop stops the robot again when that call has returned.
        """
        if goal := {key: float(self._seen[key]) for key in self._action if key in self._seen}:
            self._send(goal)

    def _send(self, goal: dict[str, float]) -> None:
        sent = self._robot.send_action(dict(goal))
        self._sent = {key: float(sent.get(key, value)) for key, value in goal.items()}


def _matched(
    names: Sequence[str], given: Mapping[str, str], features: Mapping[str, Any]
) -> list[str]:
    """The robot's key for each name of the policy."""
    keys: list[str] = []
    for name in names:
        plain = name.removeprefix(_DELTA)
        tried = [given[name]] if name in given else [name, name + _PLACE, plain, plain + _PLACE]
        if (key := next((key for key in tried if key in features), None)) is None:
            _refuse(name, f"no {' or '.join(dict.fromkeys(tried))}", names, features)
        keys.append(key)
    return keys


def _refuse(
    expected: str, actual: str, policy: Sequence[str], robot: Mapping[str, Any]
) -> NoReturn:
    raise CheckpointMismatch(
        f"LeRobotArm: the policy needs {expected}, found {actual}. The policy has "
        f"{', '.join(policy)}; the robot has {', '.join(robot)}. Name what belongs together in "
        "`cameras` (view: camera) and `motors` (channel: motor)"
    )
