"""A robot shaped like LeRobot's is driven by the policy's channels, and refused where it is not."""

import importlib.util
import json
import threading
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import MethodType
from typing import Any

import numpy as np
import pytest

from pipeline.base.config import Source
from pipeline.base.errors import CheckpointMismatch
from pipeline.data import open_recordings
from pipeline.robot.client import refuse_other_robot
from pipeline.robot.lerobot_arm import LeRobotArm, describe
from pipeline.robot.realtime import RunSettings

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "lerobot_arm.py"
MOTORS = ("shoulder_pan", "elbow_flex", "gripper")
SO101 = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


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


@pytest.mark.parametrize("copies", [False, True])
def test_a_camera_that_hangs_becomes_old(copies: bool) -> None:
    """Whether it gives the same array again, or another of the same pixels."""
    robot = Follower()
    arm = arm_of(robot)
    times = []
    for tick in range(4):
        if tick == 3:
            robot.image[:] += 1  # as one that fills the same array anew
        elif copies:
            robot.image = robot.image.copy()
        arm.observe()
        times.append(arm.frames()["View1"][0])
    assert times == [100.25, 100.25, 100.25, 101.75]


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


class Blocked(Follower):
    """Its first command waits on the bus until `go`."""

    def __init__(self) -> None:
        super().__init__()
        self.begun, self.go = threading.Event(), threading.Event()
        self.log: list[str] = []

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        first = not self.log
        self.log.append("begin")
        if first:
            self.begun.set()
            self.go.wait(60)
        self.log.append("end")
        return super().send_action(action)


@pytest.mark.parametrize("hangs", [False, True])
def test_stop_waits_for_a_command_under_way_but_not_for_one_that_hangs(
    hangs: bool, monkeypatch
) -> None:
    monkeypatch.setattr("pipeline.robot.lerobot_arm._PORT_S", 0.05 if hangs else 60.0)
    robot, said = Blocked(), list[str]()
    arm = LeRobotArm(robot, metadata_of(), {"View1": "front"}, say=said.append)
    arm.observe()
    acting = threading.Thread(target=arm.act, args=(np.ones(3),))
    acting.start()
    assert robot.begun.wait(60)
    stopping = threading.Thread(target=arm.stop, args=("no tick has ended",))
    stopping.start()
    if hangs:
        stopping.join(60)
        assert robot.sent == [robot.place]
        assert len(said) == 1 and "(no tick has ended) was sent while another call" in said[0]
    robot.go.set()
    acting.join(60)
    stopping.join(60)
    if not hangs:
        assert robot.log == ["begin", "end"] * 2
        assert (robot.sent[-1], said) == (robot.place, [])


def test_names_that_differ_are_mapped_and_describe_the_robot() -> None:
    names = ("joint_1", "joint_2", "jaw")
    motors = {name: f"{motor}.pos" for name, motor in zip(names, MOTORS, strict=True)}
    robot, cameras = Follower(), {"View1": "front"}
    arm = LeRobotArm(robot, metadata_of(action=names, state=names), cameras, motors)
    assert arm.observe()["state"].tolist() == [[0.0, 1.0, 2.0]]
    arm.act(np.array([1.0, 2.0, 3.0]))
    assert list(robot.sent[0].values()) == [1.0, 2.0, 3.0]
    assert describe(robot, cameras, {"joint_1": "shoulder_pan.pos"}) == {
        "state": (own := ["joint_1", "elbow_flex.pos", "gripper.pos"]),
        "action": own,
        "action_kind": "absolute",
        "views": ["View1"],
    }


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"state": ("wrist",)}, "needs wrist, found no wrist or wrist.pos"),
        ({"action": MOTORS[:2], "moving": (False,) * 2}, r"none for \['gripper.pos'\]"),
        ({"kind": "velocity"}, "needs actions that are velocity, found places"),
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
    """A policy for an SO-101 behind no wire: all motors a hundredth from where they are, or one by
    `far` more."""

    far = 0.0

    def __init__(self, url: str, robot: Mapping[str, Any]) -> None:
        names = [f"{motor}.pos" for motor in SO101]
        action = {"names": names, "units": [""] * 6, "kind": "absolute"}
        streams = {"action": action, "state": {"names": names, "units": [""] * 6}}
        self.metadata: dict[str, Any] = {
            "streams": {**streams, "views": ["View1"]},
            "moving": [False] * 6,
            "horizon": 8,
            "action_dim": 6,
            "action_hz": 50.0,
            "vlm_reuse_count": 3,
            "uses_features": True,
            "looks_at": ["features", "state"],
            "feature_spec": {"digest": "d"},
            "feature_spec_digest": "d",
            "state_window": 5,
            "sensor_window": 5,
        }
        refuse_other_robot(robot, self.metadata)
        self.key = np.zeros(16, np.uint8)

    def __enter__(self) -> "Policy":
        return self

    def __exit__(self, *told: object) -> None:
        pass

    def infer(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        self.key = self.key + ("images/View1" in observation)
        chunk = np.tile(np.arange(6, dtype=np.float32) + np.float32(0.01), (8, 1))
        chunk[:, 1] += self.far
        return {"actions": chunk, "feature_key": self.key, "feature_age_s": 0.01}


class Filming(Follower):
    """An SO-101 whose camera gives another image each time."""

    def __init__(self) -> None:
        super().__init__(motors=SO101)

    def get_observation(self) -> dict[str, Any]:
        self.image = self.image + np.uint8(1)
        return super().get_observation()


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch, simulated_time: Any) -> Any:
    spec = importlib.util.spec_from_file_location("lerobot_arm_example", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "PolicyClient", Policy)
    arm = partial(LeRobotArm, clock_s=simulated_time.monotonic)
    monkeypatch.setattr(module, "LeRobotArm", arm)
    monkeypatch.setattr(module, "CAMERAS", {"View1": "front"})
    return module


def test_the_example_drives_a_robot_and_records_it(example: Any, tmp_path) -> None:
    robot = Filming()
    example.drive(robot, RunSettings("Push", seconds=1.0), tmp_path)
    (root,) = tmp_path.iterdir()
    (recording,) = open_recordings([Source(name="runs", path=str(root))], tmp_path).recordings
    action, state = recording.action(), recording.state()
    assert action is not None and state is not None and action.kind == "absolute"
    assert len(action.time) == len(robot.sent) - 1 == 49, "all but the stop"
    wanted = np.tile(np.arange(6, dtype=np.float32) + np.float32(0.01), (len(action.time), 1))
    np.testing.assert_array_equal(action.values, wanted)
    assert robot.sent[-1] == robot.place
    assert list(recording.cameras()) == ["View1"] and recording.instruction == "Push"
    assert json.loads((root / "run.json").read_text())["settings"]["seconds"] == 1.0


def test_the_example_makes_too_fast_a_step_slower_and_stops_before_too_large_a_one(
    example: Any, tmp_path, monkeypatch, capsys
) -> None:
    """The run that a first action beyond a limit stops is kept."""
    monkeypatch.setattr(Policy, "far", 10.0)
    robot = Filming()
    example.drive(robot, RunSettings("Push", seconds=0.3), tmp_path / "slower")
    assert robot.sent[0]["shoulder_lift.pos"] <= 2.81 and len(robot.sent) > 1
    monkeypatch.setattr(Policy, "far", 90.0)
    robot, root = Filming(), tmp_path / "run_000000"
    example.drive(robot, RunSettings("Push", seconds=5.0), tmp_path)
    assert robot.sent == [robot.place], "the stop alone"
    printed = capsys.readouterr().out.rstrip()
    assert "step of shoulder" in printed and printed.endswith(f": {root}")
    (recording,) = open_recordings([Source(name="runs", path=str(root))], tmp_path).recordings
    state = recording.state()
    assert state is not None and len(state.time) and list(recording.cameras()) == ["View1"]
    assert "step of shoulder" in json.loads((root / "run.json").read_text())["reason"]


def test_the_example_says_why_a_run_without_an_observation_is_not_recorded(
    example: Any, tmp_path, capsys
) -> None:
    def fail(self: Filming) -> dict[str, Any]:
        raise RuntimeError("bus error")

    robot = Filming()
    robot.get_observation = MethodType(fail, robot)
    example.drive(robot, RunSettings("Push", seconds=5.0), tmp_path)
    printed = capsys.readouterr().out
    assert "None" not in printed and "bus error" in printed
    assert f"{tmp_path / 'run_000000.part'}: expected a tick" in printed


def test_the_example_refuses_a_policy_for_another_robot(example: Any, tmp_path) -> None:
    with pytest.raises(CheckpointMismatch, match="trained on another robot"):
        example.drive(Follower(), RunSettings("Push"), tmp_path)
