"""Pose conventions and the joints that stand in for a real arm's."""

import numpy as np
import pytest

from pipeline.simulation.arm import (
    NOMINAL_POSE,
    euler_actions,
    joints_deg,
    moved,
    orientation,
    robot_state,
)
from pipeline.simulation.insertion_layout import draw_layout


def test_orientation_is_mobile_xyz() -> None:
    a, b, r = np.deg2rad([20.0, -35.0, 80.0])
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_z = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
    ours = orientation(np.array([20.0, -35.0, 80.0])).as_matrix()
    np.testing.assert_allclose(ours, about_x @ about_y @ about_z, atol=1e-12)


def test_joints_tell_poses_apart_and_are_smooth_across_180() -> None:
    poses = np.tile(NOMINAL_POSE, (41, 1))
    poses[:, 5] = np.linspace(178.0, 182.0, 41)
    joints = joints_deg(poses)
    assert np.abs(np.diff(joints, axis=0)).max() < 0.1
    shown = robot_state(poses)
    assert shown.shape == (41, 12)
    assert shown[0, 11] > 177 and shown[-1, 11] < -177
    directions = joints_deg(NOMINAL_POSE + np.eye(6)) - joints_deg(NOMINAL_POSE[None])
    assert np.linalg.cond(directions) < 20


@pytest.mark.parametrize("seed", range(2))
def test_a_crossing_episode_passes_180(seed: int) -> None:
    layout = draw_layout(seed, crosses_180=True)
    begin, end = layout.start_pose[5], layout.upright_deg[2]
    assert min(begin, end) < 180 < max(begin, end)
    plain = draw_layout(seed)
    # Crossing changes where the needle's spin stands, not how the arm has to turn.
    np.testing.assert_allclose(
        layout.start_pose[3:] - layout.upright_deg, plain.start_pose[3:] - plain.upright_deg
    )
    turns = [
        (orientation(one.upright_deg) * orientation(one.start_pose[3:]).inv()).as_rotvec()
        for one in (layout, plain)
    ]
    np.testing.assert_allclose(turns[0], turns[1], atol=1e-12)


def test_moving_by_a_rotation_vector_turns_in_the_base_frame() -> None:
    turn = np.array([3.0, -2.0, 1.0])
    after = moved(NOMINAL_POSE, np.array([1.0, 2.0, 3.0, *turn, 1.0]), "rotvec")
    np.testing.assert_allclose(after[:3] - NOMINAL_POSE[:3], [1, 2, 3])
    turned = orientation(after[3:]) * orientation(NOMINAL_POSE[3:]).inv()
    np.testing.assert_allclose(turned.as_rotvec(degrees=True), turn, atol=1e-9)


def test_actions_are_wrapped_differences() -> None:
    poses = np.array([[0, 0, 0, 0, 0, 179.0], [1, 2, 3, 4, 5, -179.0]])
    np.testing.assert_allclose(euler_actions(poses), [[1, 2, 3, 4, 5, 2, 1]])
