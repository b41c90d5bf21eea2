"""Absolute actions as differences from the state at the tick."""

from dataclasses import replace

import pytest
import torch

from pipeline.base.errors import ConfigError
from pipeline.policy.robot_state import RelativeActions
from pipeline.policy.shape import channel_kinds, find_relative

STATE = {
    "names": ["joint_1", "pose_x", "pose_y", "pose_z", "pose_a", "pose_b", "pose_r"],
    "units": ["rad", "mm", "mm", "mm", "deg", "deg", "deg"],
}
KINDS = channel_kinds(**STATE)
ACTION = {
    "kind": "absolute",
    "names": ["x", "y", "z", "a", "b", "r", "gripper", "joint_1"],
    "units": ["mm"] * 3 + ["deg"] * 3 + ["", "rad"],
}


@pytest.fixture
def seen(observe):
    seen = observe(4, 13, 5)
    state = torch.randn(*seen.state.shape[:2], 7) * torch.tensor([2.0, 50, 50, 50, 170, 80, 170])
    return replace(seen, state=state)


def test_each_step_counts_from_the_state_and_back(seen):
    relative = RelativeActions(find_relative(ACTION, STATE), KINDS)
    chunks = torch.randn(2, 4, 8, 8) * torch.tensor([50.0, 50, 50, 60, 40, 60, 1, 1])
    learned, now = relative.from_absolute(chunks, seen), seen.state[:, -1]
    difference = chunks[..., :3] - now[:, None, 1:4]
    torch.testing.assert_close(learned[..., :3], difference, atol=1e-4, rtol=0)
    assert learned[..., 7].abs().max() <= torch.pi + 1e-5  # the short way round
    assert learned[..., 3:7].equal(chunks[..., 3:7])  # angles of a pose, and what it lacks
    change = relative.to_absolute(learned, seen) - chunks
    turn = torch.tensor([torch.inf] * 7 + [2 * torch.pi])
    rest = torch.where(turn.isinf(), change, change - turn * (change / turn).round())
    assert rest.abs().max() < 2e-2


def test_without_a_state_the_answer_is_no_number(seen):
    relative = RelativeActions(find_relative(ACTION, STATE), KINDS)
    blind = replace(seen, state_valid=torch.tensor([5, 5, 0, 5]))
    answer = relative.to_absolute(torch.zeros(4, 8, 8), blind)
    assert answer[2, :, :3].isnan().all() and answer[[0, 1, 3]].isfinite().all()


@pytest.mark.parametrize(
    "action",
    [ACTION | {"kind": "delta"}, {"kind": "absolute", "names": ["x"], "units": ["m"]}],
    ids=["deltas", "another unit"],
)
def test_what_the_state_does_not_measure_is_refused(action):
    with pytest.raises(ConfigError, match=r"train_head\.action_form"):
        find_relative(action, STATE)
