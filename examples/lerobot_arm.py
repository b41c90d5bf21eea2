"""A policy drives a LeRobot arm over the wire: an SO-101 here, any of LeRobot's robots alike.

Start the server where the model runs (python -m stages.serve), then this beside the arm. First in
the air: what is checked before the first action, and what each stop means, is in docs/robot.md.
"""

import sys

from pipeline.robot.client import PolicyClient
from pipeline.robot.lerobot_arm import LeRobotArm, LeRobotStyle
from pipeline.robot.realtime import LoopSettings, run_robot
from pipeline.robot.recorder import RunRecorder

CAMERAS = {"View1": "front", "View2": "wrist"}
"""The policy's views, and what the robot calls these cameras."""


def drive(robot: LeRobotStyle, server: str, instruction: str, folder: str = "runs") -> None:
    """Run the policy of a server on a connected robot, and record the run."""
    with PolicyClient(server) as policy:
        arm = LeRobotArm(robot, policy.metadata, cameras=CAMERAS)
        recorder = RunRecorder(folder, policy.metadata, instruction)
        print(run_robot(arm, policy, LoopSettings(instruction=instruction), recorder=recorder))


if __name__ == "__main__":
    from lerobot.cameras.opencv import OpenCVCameraConfig
    from lerobot.robots.so101_follower import SO101Follower, SO101FollowerConfig

    eyes = {name: OpenCVCameraConfig(i, 30, 640, 480) for i, name in enumerate(CAMERAS.values())}
    follower = SO101Follower(SO101FollowerConfig(port=sys.argv[1], cameras=eyes, use_degrees=True))
    follower.connect()
    try:
        drive(follower, "ws://127.0.0.1:8000", sys.argv[2])
    finally:
        follower.disconnect()
