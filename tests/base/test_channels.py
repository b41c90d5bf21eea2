"""Channels by name and unit."""

from pipeline.base.channels import action_groups


def test_action_groups_go_by_name_and_unit() -> None:
    names = ["dx", "dalpha", "joint1_velocity", "gripper", "Gripper_width", "mystery", "twist"]
    units = ["mm", "deg", "rad/s", "", "m", "", "mm/s"]
    assert action_groups(names, units) == (
        "translation", "rotation", "other", "gripper", "gripper", "other", "other"
    )  # fmt: skip
