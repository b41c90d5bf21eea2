"""Robot states as networks take them."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from pipeline.policy.robot_state import expand
from pipeline.policy.shape import channel_kinds, expanded_names, typical_state

NAMES = (*(f"joint_{n}" for n in range(1, 7)), *(f"pose_{axis}" for axis in "xyzabr"))
UNITS = ("deg",) * 6 + ("mm",) * 3 + ("deg",) * 3
KINDS = channel_kinds(NAMES, UNITS)


def states(seed: int = 0) -> Tensor:
    """(batch, reading, channel) of an arm that moves a little."""
    generator = torch.Generator().manual_seed(seed)
    begin = 360 * torch.rand(2, 1, 12, generator=generator) - 180
    return begin + 5 * torch.rand(2, 9, 12, generator=generator)


def test_the_arms_pose_angles_are_a_rotation_and_others_angles():
    assert KINDS == ("deg",) * 6 + ("plain",) * 3 + ("rotation",) * 3
    assert channel_kinds(["pose_a", "pose_b", "q"], ["deg", "deg", "rad"]) == ("deg", "deg", "rad")
    assert channel_kinds(["q"], [""]) == ("plain",)


@given(turned=st.lists(st.integers(-2, 2), min_size=12, max_size=12), reading=st.integers(0, 8))
def test_an_angle_written_a_turn_further_changes_nothing(turned, reading):
    values, other = states(), states()
    turns = torch.tensor(
        [360.0 * n if unit == "deg" else 0 for n, unit in zip(turned, UNITS, strict=True)]
    )
    other[:, reading] += turns
    torch.testing.assert_close(expand(other, KINDS), expand(values, KINDS), atol=2e-5, rtol=0)


def test_a_rotation_is_relative_to_the_newest_reading():
    values = states()
    six = expand(values, KINDS)[..., -6:].double()
    turns = Rotation.from_euler("XYZ", values[0, :, 9:].numpy(), degrees=True)
    relative = (turns[-1].inv() * turns).as_matrix()
    expected = torch.tensor(relative)[:, :, :2].mT.flatten(1)
    torch.testing.assert_close(six[0], expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("kinds", [KINDS, ("plain",) * 12, ("rad", "deg") * 6])
def test_every_channel_has_a_name(kinds):
    assert len(expanded_names(NAMES, kinds)) == expand(states(), kinds).shape[-1]


def test_a_typical_state_expands_to_the_mean():
    mean = expand(states()[:1, -1:], KINDS)[0, 0]
    back = torch.tensor([[typical_state(mean.tolist(), KINDS)]])
    torch.testing.assert_close(expand(back, KINDS)[0, 0], mean, atol=1e-5, rtol=0)


def test_radians_are_angles_too():
    values = torch.tensor([[[math.pi / 6]]])
    assert expand(values, ("rad",))[0, 0].tolist() == pytest.approx([0.5, math.sqrt(0.75)])
