"""Chunks that count from a state: that at the newest frame, or that at the tick."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import ConfigError
from pipeline.policy.expert import Guide
from pipeline.policy.robot_state import Anchoring, RelativeActions, state_at_frame
from pipeline.policy.shape import Anchor, channel_kinds, find_anchors, find_relative

POSE = {
    "names": ["joint_1", "pose_x", "pose_y", "pose_z", "pose_a", "pose_b", "pose_r"],
    "units": ["rad", "mm", "mm", "mm", "deg", "deg", "deg"],
}
KINDS = channel_kinds(**POSE)
ROTVEC = {
    "kind": "delta",
    "names": ["dx", "dy", "dz", "rx", "ry", "rz", "gripper"],
    "units": ["mm"] * 3 + ["deg"] * 3 + [""],
}
ABSOLUTE = {
    "kind": "absolute",
    "names": ["x", "y", "z", "a", "b", "r", "gripper", "joint_1"],
    "units": ["mm"] * 3 + ["deg"] * 3 + ["", "rad"],
}
START = torch.tensor([3.1, 5.0, -4.0, 0.0, 20.0, 10.0, 179.0])
SPEED = torch.tensor([2.0, 10.0, -3.0, 1.0, 30.0, 20.0, 40.0])
"""A second: joint and rotation pass half a turn."""


@pytest.fixture
def moving(observe):
    """Four samples of an arm in steady motion; the frame of each is older than the one before."""
    seen = observe(4, 13, 25)
    state = START - seen.state_age[..., None] * SPEED
    state[..., 0] = (state[..., 0] + np.pi) % (2 * np.pi) - np.pi
    state[..., 6] = (state[..., 6] + 180) % 360 - 180
    return replace(seen, state=state, feature_age=torch.tensor([0.0, 0.03, 0.31, 0.9]))


def test_the_state_is_interpolated_on_its_clock(moving):
    oldest = replace(moving, feature_age=moving.state_age[:, :2].mean(dim=1))
    for seen in (moving, oldest):
        change = state_at_frame(seen, KINDS) - seen.state[:, -1]
        turn = torch.tensor([2 * np.pi, *[torch.inf] * 3, 360.0, 360.0, 360.0])
        change = torch.where(turn.isinf(), change, (change + turn / 2) % turn - turn / 2)
        torch.testing.assert_close(change, -seen.feature_age[:, None] * SPEED, atol=2e-4, rtol=0)


def test_a_step_counts_from_the_frame_and_back(moving):
    anchoring = Anchoring(find_anchors(ROTVEC, POSE, ["dx", "dy", "rx", "ry", "rz"]), KINDS)
    chunks = torch.randn(2, 4, 8, 7)
    counted = anchoring.from_frame(chunks, moving)
    assert counted[..., 1:, :].equal(chunks[..., 1:, :])
    assert counted[..., [2, 6]].equal(chunks[..., [2, 6]])
    moved = (moving.feature_age[:, None] * SPEED[1:3]).expand(2, 4, 2)
    torch.testing.assert_close(counted[..., 0, :2], chunks[..., 0, :2] + moved, atol=1e-4, rtol=0)
    now, then = (
        Rotation.from_euler("XYZ", angles[:, 4:].double(), degrees=True)
        for angles in (moving.state[:, -1], state_at_frame(moving, KINDS))
    )
    step = Rotation.from_rotvec(chunks[0, :, 0, 3:6].double(), degrees=True)
    composed = torch.from_numpy((step * now * then.inv()).as_rotvec(degrees=True)).float()
    torch.testing.assert_close(counted[0, :, 0, 3:6], composed, atol=1e-3, rtol=0)
    torch.testing.assert_close(anchoring.from_tick(counted, moving), chunks, atol=1e-3, rtol=0)


@pytest.mark.parametrize("missing", ["slot_valid", "state_valid"])
def test_without_frames_or_states_it_counts_from_the_tick(moving, missing):
    moving = replace(moving, **{missing: torch.zeros_like(getattr(moving, missing))})
    chunks = torch.randn(4, 8, 7)
    anchoring = Anchoring(find_anchors(ROTVEC, POSE, ["dx"]), KINDS)
    for count in (anchoring.from_frame, anchoring.from_tick):
        torch.testing.assert_close(count(chunks, moving), chunks)


def test_channels_that_the_state_tells():
    joints = {"kind": "delta", "names": ["joint_1", "wrist"], "units": ["rad", "rad"]}
    assert find_anchors(joints, POSE, ["joint_1"]) == (Anchor((0,), (0,)),)
    euler = {**ROTVEC, "names": ["dx", "dy", "dz", "da", "db", "dr", "gripper"]}
    assert find_anchors(euler, POSE, ["db", "dx"]) == (Anchor((4,), (5,)), Anchor((0,), (1,)))
    for action, wanted in (
        (euler, ["dx", "gripper"]),
        (joints, ["wrist"]),
        (ROTVEC, ["rx"]),  # a rotation vector is anchored whole
        ({**euler, "kind": "velocity"}, ["dx"]),
        ({**euler, "units": ["m"] * 7}, ["dx"]),
    ):
        with pytest.raises(ConfigError, match=rf"train_head\.anchor: .*found {wanted[-1]}"):
            find_anchors(action, POSE, wanted)


def test_it_needs_frames_and_states():
    for off in ("features_enabled", "robot_state_enabled"):
        with pytest.raises(ValueError, match="anchor counts from the newest frame"):
            TrainHeadParams.model_validate({"anchor": ["dx"], off: False})


def test_a_policy_learns_and_answers_from_the_frame(build_policy, observe, shape):
    plain = build_policy(model_type="flow_matching").eval()
    anchored = build_policy(model_type="flow_matching").eval()
    anchored.anchoring = count = Anchoring((Anchor((0,), (3,)),), shape.kinds)
    seen = observe()
    target = count.from_frame(seen.action, seen)
    assert not target.equal(seen.action)

    def drawn() -> torch.Generator:
        return torch.Generator().manual_seed(3)

    torch.testing.assert_close(
        anchored.act(seen, drawn()), count.from_tick(plain.act(seen, drawn()), seen)
    )
    loss = anchored.loss(seen, seen.action, seen.action_valid, drawn())[0]
    torch.testing.assert_close(loss, plain.loss(seen, target, seen.action_valid, drawn())[0])
    weight = torch.ones(4, 8)
    guided = anchored.act(seen, drawn(), Guide(seen.action, weight))
    wanted = plain.act(seen, drawn(), Guide(target, weight))
    torch.testing.assert_close(guided, count.from_tick(wanted, seen))


def test_older_readings_tell_the_motion_and_nothing_else(build_policy, observe):
    policy = build_policy(state_window=8, state_window_s=0.3).eval()
    seen = observe(2)
    readings, within = seen.state.shape[1], (seen.state_age <= 0.3).sum(dim=1)
    assert within.min() > 0 and within.max() < readings, "some are older than the window"
    other = replace(seen, state=seen.state.clone())
    for row, count in enumerate(within.tolist()):
        other.state[row, : readings - min(count, 8)] += 5.0
    assert not policy.shape.anchors, "so nothing counts from a frame here"
    assert policy.act(other).equal(policy.act(seen))
    other.state[:, -1] += 5.0
    assert not policy.act(other).equal(policy.act(seen))
    none = torch.zeros(2, dtype=torch.int64)
    tokens = policy._encode_window("state", seen, none)
    assert tokens.equal(
        policy._encode_window("state", replace(seen, state=seen.state + 5.0), none)
    ), "a state that is dropped is missing, however old its readings are"


@pytest.fixture
def anywhere(observe):
    seen = observe(4, 13, 5)
    state = torch.randn(*seen.state.shape[:2], 7) * torch.tensor([2.0, 50, 50, 50, 170, 80, 170])
    return replace(seen, state=state)


def test_each_step_counts_from_the_state_and_back(anywhere):
    relative = RelativeActions(find_relative(ABSOLUTE, POSE), KINDS)
    chunks = torch.randn(2, 4, 8, 8) * torch.tensor([50.0, 50, 50, 60, 40, 60, 1, 1])
    learned, now = relative.from_absolute(chunks, anywhere), anywhere.state[:, -1]
    difference = chunks[..., :3] - now[:, None, 1:4]
    torch.testing.assert_close(learned[..., :3], difference, atol=1e-4, rtol=0)
    assert learned[..., 7].abs().max() <= torch.pi + 1e-5  # the short way round
    assert learned[..., 3:7].equal(chunks[..., 3:7])  # angles of a pose, and what it lacks
    change = relative.to_absolute(learned, anywhere) - chunks
    turn = torch.tensor([torch.inf] * 7 + [2 * torch.pi])
    rest = torch.where(turn.isinf(), change, change - turn * (change / turn).round())
    assert rest.abs().max() < 2e-2


def test_without_a_state_the_answer_is_no_number(anywhere):
    relative = RelativeActions(find_relative(ABSOLUTE, POSE), KINDS)
    blind = replace(anywhere, state_valid=torch.tensor([5, 5, 0, 5]))
    answer = relative.to_absolute(torch.zeros(4, 8, 8), blind)
    assert answer[2, :, :3].isnan().all() and answer[[0, 1, 3]].isfinite().all()


@pytest.mark.parametrize(
    "action",
    [ABSOLUTE | {"kind": "delta"}, {"kind": "absolute", "names": ["x"], "units": ["m"]}],
    ids=["deltas", "another unit"],
)
def test_what_the_state_does_not_measure_is_refused(action):
    with pytest.raises(ConfigError, match=r"train_head\.action_form"):
        find_relative(action, POSE)
