"""The arm that carries the needle: its pose convention, its motion, a stand-in for its joints.

A pose is x y z of the needle's tip in mm and a b r in degrees, both in the base frame, with the
rotation R = Rx(a)·Ry(b)·Rz(r) (mobile XYZ). The needle points down (-z) when the arm is upright.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.data.timeline import ActionRotation, wrapped_deg

NOMINAL_POSE = np.array([82.0, 111.0, 253.0, -136.0, 38.0, -158.0])
"""The pose, roughly, of a Meca500 with this tool when it inserts."""

_HOME_JOINTS_DEG = np.array([10.0, 20.0, -15.0, 5.0, 30.0, -60.0])
_JOINTS_PER_POSE = np.array(
    [
        [-0.31, 0.22, 0.00, 0.04, -0.05, 0.02],
        [0.17, 0.24, -0.21, -0.06, 0.11, 0.01],
        [0.12, 0.15, 0.33, 0.08, 0.05, -0.03],
        [0.05, -0.08, 0.02, 0.71, -0.22, 0.13],
        [-0.09, 0.04, 0.10, 0.19, 0.64, 0.08],
        [0.03, 0.07, -0.04, -0.25, 0.17, 0.82],
    ]
)


def orientation(abr_deg: NDArray[np.float64]) -> Rotation:
    """R = Rx(a)·Ry(b)·Rz(r) of angles (..., 3) in degrees."""
    return Rotation.from_euler("XYZ", abr_deg, degrees=True)


def angles_deg(rotation: Rotation) -> NDArray[np.float64]:
    """The angles a b r (3,) of a rotation, each in [-180, 180]."""
    return np.asarray(rotation.as_euler("XYZ", degrees=True), np.float64)


def joints_deg(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Joint angles (row, 6) for poses (row, 6): a stand-in, not a Meca500's inverse kinematics.

    It is a fixed linear map around the nominal pose, one to one and smooth, even where r crosses
    ±180°.
    """
    from_nominal = poses - NOMINAL_POSE
    from_nominal[..., 3:] = wrapped_deg(from_nominal[..., 3:])
    return _HOME_JOINTS_DEG + from_nominal @ _JOINTS_PER_POSE.T


def robot_state(poses: NDArray[np.float64]) -> NDArray[np.float32]:
    """Readings (row, 12) of joints and pose, angles wrapped, for poses (row, 6)."""
    shown = poses.copy()
    shown[..., 3:] = wrapped_deg(shown[..., 3:])
    return np.concatenate([joints_deg(poses), shown], axis=-1).astype(np.float32)


def moved(
    pose: NDArray[np.float64], action: NDArray[np.float64], rotation: ActionRotation
) -> NDArray[np.float64]:
    """The pose (6,) after an action: base-frame translation (mm), then its rotation (deg).

    The angles are not wrapped: they stay within half a turn of the pose they come from.
    """
    after = pose.copy()
    after[:3] += action[:3]
    if rotation == "euler_delta":
        after[3:] += action[3:6]
        return after
    turned = Rotation.from_rotvec(action[3:6], degrees=True) * orientation(pose[3:])
    after[3:] += wrapped_deg(angles_deg(turned) - pose[3:])
    return after


def euler_actions(poses: NDArray[np.float64]) -> NDArray[np.float32]:
    """Actions (row - 1, 7) from each of the poses (row, 6) to the next: mm, wrapped a b r, 1."""
    steps = np.diff(poses, axis=0)
    steps[:, 3:] = wrapped_deg(steps[:, 3:])
    return np.column_stack([steps, np.ones(len(steps))]).astype(np.float32)


LAG_S: Final = 0.04
"""Time constant with which the arm follows its controller's reference."""
_SPEED: Final = np.array([12.0, 30.0])
"""Limits of the reference's translation, mm/s, and of each angle, deg/s."""
_ACCELERATION: Final = np.array([120.0, 300.0])
"""Limits of the change of the reference's velocity from tick to tick, mm/s² and deg/s²."""


@dataclass(frozen=True)
class ArmMotion:
    """How the arm moves during a tick: its controller leads, its joints follow with a lag.

    The reference goes from `reference` (6,) at `velocity` (6,), mm/s and deg/s. From `pose` (6,)
    the arm follows it as dp/dt = (reference - p) / LAG_S: its velocity has no steps, and its
    acceleration is at most the change of the reference's velocity over the lag. Angles are not
    wrapped.
    """

    pose: NDArray[np.float64]
    reference: NDArray[np.float64]
    velocity: NDArray[np.float64]

    @classmethod
    def resting(cls, pose: NDArray[np.float64]) -> "ArmMotion":
        """The arm standing still."""
        return cls(pose, pose, np.zeros(6))

    def at(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Poses (time, 6) at times since the tick began: the response to a ramp, in closed form."""
        time = np.asarray(seconds)[..., None]
        behind = self.velocity * LAG_S
        decay = np.exp(-time / LAG_S)
        return (
            self.reference
            + time * self.velocity
            - behind
            + decay * (self.pose - self.reference + behind)
        )

    def towards(self, setpoint: NDArray[np.float64], tick_s: float) -> "ArmMotion":
        """The motion of the next tick, towards `setpoint` (6,) within the limits of the arm."""
        reference = self.reference + tick_s * self.velocity
        wanted = _limited((setpoint - reference) / tick_s, _SPEED)
        change = _limited(wanted - self.velocity, _ACCELERATION * tick_s)
        return ArmMotion(self.at(np.array([tick_s]))[0], reference, self.velocity + change)


def _limited(values: NDArray[np.float64], limits: NDArray[np.float64]) -> NDArray[np.float64]:
    """The values (6,) with their direction, shortened to these limits of translation and angle."""
    lengths = np.array([np.linalg.norm(values[:3]), np.abs(values[3:]).max()])
    return values * np.repeat(np.minimum(1.0, limits / np.maximum(lengths, 1e-12)), 3)
