"""A robot shaped like LeRobot's is driven by the policy's channels, and refused where it is not."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from pipeline.base.errors import CheckpointMismatch
from pipeline.robot.lerobot_arm import LeRobotArm

MOTORS = ("shoulder_pan", "elbow_flex", "gripper")


class Follower:
    """As LeRobot's SO-101 follower answers: floats by motor, images by camera, clipped actions."""

    def __init__(self, largest: float = 100.0, motors: tuple[str, ...] = MOTORS) -> None:
        self.place = {f"{motor}.pos": float(i) for i, motor in enumerate(motors)}
        self.image = np.zeros((4, 6, 3), np.uint8)
        self.asked = 0
        self.largest, self.broken = largest, False
        self.sent: list[dict[str, float]] = []

    @property
    def observation_features(self) -> dict[str, Any]:
        return {**dict.fromkeys(self.place, float), "front": (4, 6, 3)}

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys(self.place, float)

    def get_observation(self) -> dict[str, Any]:
        self.asked += 1
        if self.broken:
            raise ConnectionError("no answer on the bus")
        return {**self.place, "front": self.image}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        sent = {key: min(value, self.largest) for key, value in action.items()}
        self.sent.append(sent)
        return sent


def metadata_of(
    action: tuple[str, ...] = tuple(f"{motor}.pos" for motor in MOTORS),
    kind: str = "absolute",
    moving: tuple[bool, ...] = (False,) * 3,
    state: tuple[str, ...] = MOTORS,
    views: tuple[str, ...] = ("View1",),
) -> Mapping[str, Any]:
    streams = {"action": {"names": action, "kind": kind}, "state": {"names": state}}
    return {"streams": {**streams, "views": views}, "moving": moving}


class Clock:
    def __init__(self) -> None:
        self.time_s = 100.0

    def __call__(self) -> float:
        self.time_s += 0.25
        return self.time_s


def arm_of(robot: Follower, **changed: Any) -> LeRobotArm:
    return LeRobotArm(robot, metadata_of(**changed), {"View1": "front"}, clock_s=Clock())


def test_one_observation_a_tick_gives_state_time_and_frames_and_actions_go_by_name() -> None:
    """An image is older than the call that gave it by the camera's latency."""
    robot, names = Follower(), ("gripper.pos", "elbow_flex", "shoulder_pan.pos")
    metadata = metadata_of(state=("gripper", "shoulder_pan"), action=names)
    arm = LeRobotArm(robot, metadata, {"View1": "front"}, None, Clock(), 0.125)
    observed = arm.observe()
    assert observed["state"].tolist() == [[2.0, 0.0]] and observed["state"].dtype == np.float32
    assert (observed["state_time"].tolist(), observed["time"].tolist()) == ([100.25], [100.5])
    ((view, (time_s, image)),) = arm.frames().items()
    assert (view, time_s, image is robot.image, robot.asked) == ("View1", 100.125, True, 1)
    arm.act(np.array([7, 8, 9], np.float32))
    assert robot.sent == [{"gripper.pos": 7.0, "elbow_flex.pos": 8.0, "shoulder_pan.pos": 9.0}]


def test_deltas_add_up_on_what_was_sent_and_not_on_what_is_measured() -> None:
    robot = Follower(largest=1.75)
    names = ("delta_shoulder_pan.pos", "delta_elbow_flex", "gripper")
    arm = arm_of(robot, action=names, kind="delta", moving=(True, True, False))
    arm.observe()
    for _ in range(3):
        arm.act(np.array([0.5, 0.5, 1.0]))
    places = [[sent[f"{motor}.pos"] for motor in MOTORS] for sent in robot.sent]
    assert places == [[0.5, 1.5, 1.0], [1.0, 1.75, 1.0], [1.5, 1.75, 1.0]]
    arm.act(np.array([0, -0.5, 1.0]))  # from where the robot clipped, at once back again
    assert robot.sent[-1]["elbow_flex.pos"] == 1.25


def test_stop_holds_where_the_robot_was_last_seen_without_asking_and_deltas_begin_there() -> None:
    robot = Follower()
    arm = arm_of(robot, kind="delta", moving=(True, True, True))
    arm.stop("no server")
    assert robot.sent == [], "nothing was seen yet"
    arm.observe()
    arm.act(np.array([5.0, 5.0, 5.0]))
    robot.broken = True
    arm.stop("force beyond 2.5 N")
    assert (robot.sent[-1], robot.asked) == (robot.place, 1)
    arm.act(np.zeros(3))
    assert robot.sent[-1] == robot.place


def test_names_that_differ_are_mapped() -> None:
    names = ("joint_1", "joint_2", "jaw")
    motors = {name: f"{motor}.pos" for name, motor in zip(names, MOTORS, strict=True)}
    robot, cameras = Follower(), {"View1": "front"}
    arm = LeRobotArm(robot, metadata_of(action=names, state=names), cameras, motors)
    assert arm.observe()["state"].tolist() == [[0.0, 1.0, 2.0]]
    arm.act(np.array([1.0, 2.0, 3.0]))
    assert list(robot.sent[0].values()) == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"state": ("wrist",)}, "needs wrist, found no wrist or wrist.pos"),
        ({"action": MOTORS[:2], "moving": (False,) * 2}, r"none for \['gripper.pos'\]"),
        ({"kind": "velocity"}, "needs actions that are velocity, found places"),
        ({"views": ()}, r"needs mappings of what it has, found \['View1'\]"),
    ],
)
def test_what_does_not_fit_is_refused_with_both_sides(changed: Any, said: str) -> None:
    with pytest.raises(CheckpointMismatch, match=said) as refused:
        arm_of(Follower(), **changed)
    assert "the robot has shoulder_pan.pos, elbow_flex.pos, gripper.pos" in str(refused.value)


def test_a_delta_of_a_motor_that_is_not_observed_is_refused() -> None:
    class Blind(Follower):
        @property
        def observation_features(self) -> dict[str, Any]:
            return {"front": (4, 6, 3)}

    metadata = metadata_of(kind="delta", moving=(True, True, False), state=(), views=("front",))
    with pytest.raises(CheckpointMismatch, match=r"found \['elbow_flex.pos', 'shoulder_pan.pos'\]"):
        LeRobotArm(Blind(), metadata)
