"""Limits from a file: what is refused, what stops the robot, and what is cut off."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.base.config import LimitsFile
from pipeline.base.errors import ConfigError
from pipeline.data.insertion import SENSOR
from pipeline.robot.limits import Limits
from pipeline.robot.loop import SafeStop, StopKind
from pipeline.simulation.insertion import NeedleInsertion
from tests.robot.conftest import SOURCE

PHANTOM = {"streams": SOURCE["streams"], "moving": [True] * 6 + [False]}
JOINTS: dict[str, Any] = {
    "streams": {
        "action": {"names": ["a", "b"], "units": ["deg", "deg"], "kind": "absolute"},
        "state": {"names": ["b", "a"], "units": ["deg", "deg"]},
        "sensor": {"names": [], "units": []},
    },
    "moving": [False, False],
}
VELOCITY: dict[str, Any] = {
    "streams": {
        "action": {"names": ["vx", "grip"], "units": ["mm/s", ""], "kind": "velocity"},
        "state": {"names": ["grip"], "units": [""]},
        "sensor": {"names": [], "units": []},
    },
    "moving": [True, False],
}
HZ = 10.0
EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "limits.yaml"


def limits(metadata: dict[str, Any] = PHANTOM, **file: Any) -> Limits:
    return Limits(LimitsFile.model_validate(file), metadata, HZ)


def moved(*values: float) -> np.ndarray:
    return np.array([*values, *[0.0] * (6 - len(values)), 1.0])


def test_limits_say_whose_readings_they_need() -> None:
    assert limits(force={"most": {SENSOR.names[0]: 1.0}}).streams == {"sensor"}
    assert limits(step={"most": {"dx": 1.0}}).streams == set()
    assert limits(JOINTS, step={"most": {"a": 1.0}}).streams == {"state"}


@pytest.mark.parametrize(
    ("file", "action", "said"),
    [
        ({"step": {"most": {"translation": 1.0}}}, moved(0.8, 0.8), "step of translation.*1.131"),
        ({"step": {"most": {"dy": 1.0}}}, moved(0.0, -1.5), "step of dy would be 1.5, at most 1"),
        ({"speed": {"most": {"rotation": 5.0}}}, moved(0, 0, 0, 0.6), "speed of rotation.* 6,"),
        ({"acceleration": {"most": {"dx": 50.0}}}, moved(0.6), "acceleration of dx would be 60"),
    ],
)
def test_a_motion_beyond_a_limit_stops(file: dict[str, Any], action: Any, said: str) -> None:
    with pytest.raises(SafeStop, match=said) as stop:
        limits(**file).allow(action)
    assert stop.value.kind == StopKind.LIMIT


def test_a_group_is_cut_in_its_direction_and_other_channels_are_left_alone() -> None:
    own = limits(speed={"most": {"translation": 5.0}, "on_exceed": "clip"})
    sent = own.allow(moved(0.6, 0.8, 0.0, 9.0))
    np.testing.assert_allclose(sent, moved(0.3, 0.4, 0.0, 9.0))
    assert own.clipped == 1


def test_an_acceleration_is_counted_from_what_was_really_sent() -> None:
    own = limits(acceleration={"most": {"dx": 20.0}, "on_exceed": "clip"})
    wanted = moved(1.0)
    assert [round(own.allow(wanted)[0], 9) for _ in range(6)] == [0.2, 0.4, 0.6, 0.8, 1.0, 1.0]
    own.stood_still()
    assert own.allow(wanted)[0] == pytest.approx(0.2)
    own.reset()
    assert own.allow(-wanted)[0] == pytest.approx(-0.2)


def test_what_is_clipped_to_one_limit_is_judged_by_the_next() -> None:
    both = {"speed": {"most": {"dx": 5.0}, "on_exceed": "clip"}}
    assert limits(**both, acceleration={"most": {"dx": 51}}).allow(moved(0.9))[0] == 0.5
    with pytest.raises(SafeStop, match="acceleration of dx would be 50"):
        limits(**both, acceleration={"most": {"dx": 49}}).allow(moved(0.9))


def test_a_clip_that_would_undo_an_earlier_limit_stops() -> None:
    own = limits(
        speed={"most": {"translation": 10.0}, "on_exceed": "clip"},
        acceleration={"most": {"dx": 5.0}, "on_exceed": "clip"},
    )
    for tick in range(20):
        own.allow(moved(0.05 * (tick + 1)))
    with pytest.raises(SafeStop, match=r"speed of translation would be 13\.79, at most 10"):
        own.allow(moved(0.0, 1.0))  # dx can only be slowed down to 0.95
    assert own.clipped == 0


def test_channels_that_say_where_to_be_are_judged_by_where_the_robot_is() -> None:
    own = limits(JOINTS, step={"most": {"a": 2.0}, "on_exceed": "clip"})
    own.check({"state": np.array([[0.0, 9.0], [50.0, 10.0]], np.float32)})  # b, a
    np.testing.assert_allclose(own.allow(np.array([15.0, 99.0])), [12.0, 99.0])
    np.testing.assert_allclose(own.allow(np.array([15.0, 99.0])), [14.0, 99.0])
    np.testing.assert_allclose(own.allow(np.array([15.0, 99.0])), [15.0, 99.0])


def test_until_the_first_action_is_sent_the_newest_reading_says_where_the_robot_is() -> None:
    own = limits(JOINTS, step={"most": {"a": 2.0}})
    with pytest.raises(SafeStop, match="no reading says where a begins"):
        own.allow(np.array([1.0, 1.0]))
    own.check({"state": np.array([[0.0, 10.0]])})
    own.check({})
    own.check({"state": np.array([[0.0, 60.0]])})  # moved by hand
    with pytest.raises(SafeStop, match="step of a would be 49, at most 2"):
        own.allow(np.array([11.0, 0.0]))
    own.allow(np.array([61.0, 0.0]))
    own.check({"state": np.array([[0.0, 60.0]])})  # the arm is slow; what was sent holds
    own.allow(np.array([63.0, 0.0]))
    own.reset()
    own.check({"state": np.array([[0.0, 10.0]])})
    own.allow(np.array([11.0, 0.0]))


def test_a_velocity_is_a_speed_and_goes_on_where_nothing_is_sent_but_a_place_is_held() -> None:
    speed = limits(VELOCITY, speed={"most": {"vx": 5.0}, "on_exceed": "clip"})
    assert speed.allow(np.array([7.0, 0.0]))[0] == pytest.approx(5.0)
    step = limits(VELOCITY, step={"most": {"vx": 0.4}, "on_exceed": "clip"})
    assert step.allow(np.array([7.0, 0.0]))[0] == pytest.approx(4.0)
    own = limits(VELOCITY, acceleration={"most": {"vx": 1000.0, "grip": 300.0}})
    own.check({"state": np.array([[0.0]])})
    own.allow(np.array([90.0, 2.0]))
    own.stood_still()
    with pytest.raises(SafeStop, match="acceleration of vx would be 1800, at most 1000"):
        own.allow(np.array([-90.0, 2.0]))
    with pytest.raises(SafeStop, match="acceleration of grip would be 400, at most 300"):
        own.allow(np.array([90.0, 6.0]))
    own.allow(np.array([90.0, -1.0]))


def test_demonstrations_keep_to_the_example() -> None:
    own, insertion = Limits.read(EXAMPLE, PHANTOM, HZ), NeedleInsertion()
    insertion.reset(6, "moved")
    while not insertion.finished:
        action = insertion.expert_action()
        assert own.allow(action) is action
        insertion.step(action)
        own.check({"state": insertion.state, "sensor": insertion.sensor})


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("sped: {most: {dx: 1}}", "sped: unknown key"),
        ("speed: {most: {dq: 1}}", "speed.most.dq: the action has no such channel; it has trans"),
        ("force: {most: {torque: 1}}", "force.most.torque: the sensor has no such channel; it has"),
        ("workspace: {box: {pose_x: [2, 1]}}", "workspace.box.pose_x: expected the lowest and"),
        ("speed: {most: {gripper: 1}}", "gripper says where to be, and the state has no channel"),
    ],
)
def test_what_a_file_gets_wrong_is_told_by_file_and_key(tmp_path, text: str, said: str) -> None:
    path = tmp_path / "limits.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=re.escape(said)) as error:
        Limits.read(path, PHANTOM, HZ)
    assert str(path) in str(error.value)
