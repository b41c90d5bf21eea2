"""A robot shaped like LeRobot's is driven by the policy's channels, and refused where it is not."""

import importlib.util
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.base.config import Source
from pipeline.base.errors import CheckpointMismatch
from pipeline.data import open_recordings
from pipeline.robot.lerobot_arm import LeRobotArm

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "lerobot_arm.py"
MOTORS = ("shoulder_pan", "elbow_flex", "gripper")


class Follower:
    """As LeRobot's SO-101 follower answers: floats by motor, images by camera, clipped actions."""

    def __init__(self, largest: float = 100.0) -> None:
        self.place = {f"{motor}.pos": float(i) for i, motor in enumerate(MOTORS)}
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


def test_one_observation_a_tick_gives_state_time_and_frames() -> None:
    robot = Follower()
    arm = arm_of(robot, state=("gripper", "shoulder_pan"))
    observed = arm.observe()
    assert observed["state"].tolist() == [[2.0, 0.0]] and observed["state"].dtype == np.float32
    assert (observed["state_time"].tolist(), observed["time"].tolist()) == ([100.25], [100.5])
    ((view, (time_s, image)),) = arm.frames().items()
    assert (view, time_s, image is robot.image, robot.asked) == ("View1", 100.25, True, 1)


def test_absolute_actions_go_to_the_motors_that_the_channels_name() -> None:
    robot = Follower()
    arm = arm_of(robot, action=("gripper.pos", "elbow_flex", "shoulder_pan.pos"))
    arm.observe()
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


def test_stop_holds_where_the_robot_is_and_deltas_begin_there() -> None:
    robot = Follower()
    arm = arm_of(robot, kind="delta", moving=(True, True, True))
    arm.observe()
    arm.act(np.array([5.0, 5.0, 5.0]))
    robot.place = {key: value + 1 for key, value in robot.place.items()}
    arm.stop("force beyond 2.5 N")
    assert robot.sent[-1] == robot.place
    arm.act(np.zeros(3))
    assert robot.sent[-1] == robot.place


def test_a_robot_that_does_not_answer_is_stopped_where_it_was_last_seen() -> None:
    robot = Follower()
    arm = arm_of(robot)
    arm.observe()
    arm.act(np.array([50.0, 50.0, 50.0]))
    robot.broken = True
    with pytest.raises(ConnectionError):
        arm.stop("no readings")
    assert robot.sent[-1] == robot.place


def test_names_that_differ_are_mapped() -> None:
    names = ("joint_1", "joint_2", "jaw")
    motors = {name: f"{motor}.pos" for name, motor in zip(names, MOTORS, strict=True)}
    metadata = metadata_of(action=names, state=names)
    robot = Follower()
    arm = LeRobotArm(robot, metadata, {"View1": "front"}, motors)
    assert arm.observe()["state"].tolist() == [[0.0, 1.0, 2.0]]
    arm.act(np.array([1.0, 2.0, 3.0]))
    assert list(robot.sent[0].values()) == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"state": ("wrist",)}, "needs wrist, found no wrist or wrist.pos"),
        ({"action": MOTORS[:2], "moving": (False,) * 2}, r"none for \['gripper.pos'\]"),
        ({"action": ("a", "b", "c")}, "needs a, found no a or a.pos"),
        ({"kind": "velocity"}, "needs places, found velocities"),
        ({"views": ("View1", "View2")}, "needs View2, found no View2"),
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


class Policy:
    """A policy behind no wire: it moves every motor by a hundredth of a degree a tick."""

    def __init__(self, url: str) -> None:
        channels = [f"delta_{motor}.pos" for motor in MOTORS]
        action = {"names": channels, "units": ["deg"] * 3, "kind": "delta"}
        state = {"names": list(MOTORS), "units": ["deg"] * 3}
        streams = {"action": action, "state": state, "views": ["View1"]}
        self.metadata: dict[str, Any] = {
            "streams": streams,
            "moving": [True] * 3,
            "horizon": 8,
            "action_dim": 3,
            "action_hz": 50.0,
            "vlm_reuse_count": 3,
            "uses_features": True,
            "looks_at": ["features", "state"],
            "feature_spec": {"digest": "d"},
            "feature_spec_digest": "d",
            "state_window": 5,
            "sensor_window": 5,
        }
        self.key = np.zeros(16, np.uint8)

    def __enter__(self) -> "Policy":
        return self

    def __exit__(self, *told: object) -> None:
        pass

    def infer(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        self.key = self.key + ("images/View1" in observation)
        chunk = np.full((8, 3), 0.01, np.float32)
        return {"actions": chunk, "feature_key": self.key, "feature_age_s": 0.01}


def test_the_example_drives_a_robot_and_records_it(tmp_path: Path, monkeypatch) -> None:
    realtime = pytest.importorskip("pipeline.robot.realtime")
    spec = importlib.util.spec_from_file_location("lerobot_arm_example", EXAMPLE)
    assert spec is not None and spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    monkeypatch.setattr(example, "PolicyClient", Policy)
    monkeypatch.setattr(example, "CAMERAS", {"View1": "front"})
    robot = Follower()
    settings = realtime.RunSettings(instruction="Push", seconds=1.0, missed_in_a_row=1000)
    example.drive(robot, settings, tmp_path)
    (root,) = tmp_path.iterdir()
    (recording,) = open_recordings([Source(name="runs", path=str(root))], tmp_path).recordings
    action, state = recording.action(), recording.state()
    assert action is not None and state is not None and action.kind == "delta"
    assert len(action.time) == len(robot.sent) - 1 > 5, "all but the stop"
    np.testing.assert_array_equal(action.values, np.full((len(action.time), 3), 0.01, np.float32))
    assert robot.sent[-1] == robot.place
    assert list(recording.cameras()) == ["View1"] and recording.instruction == "Push"
    assert json.loads((root / "run.json").read_text())["settings"]["seconds"] == 1.0


def test_the_example_is_short() -> None:
    assert len(EXAMPLE.read_text().splitlines()) <= 40
