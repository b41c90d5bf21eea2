"""A policy drives a LeRobot arm over the wire: python examples/lerobot_arm.py PORT INSTRUCTION.

An SO-101 here, any of LeRobot's alike. What to do before the first action: docs/robot.md.
"""

import sys
from pathlib import Path

from pipeline.robot.client import PolicyClient
from pipeline.robot.lerobot_arm import LeRobotArm, describe
from pipeline.robot.limits import Limits
from pipeline.robot.realtime import RunSettings, run_robot
from pipeline.robot.recorder import RunRecorder

CAMERAS = {"View1": "front", "View2": "wrist"}  # the policy's views, and the robot's cameras
LIMITS = Path(__file__).with_name("lerobot_limits.yaml")  # those of your own table
URL = "ws://127.0.0.1:8000"


def drive(robot: object, settings: RunSettings, folder: Path = Path("runs")) -> None:
    """Run a connected robot until the settings or Ctrl-C end it, and record what happens."""
    with PolicyClient(URL, robot=describe(robot, CAMERAS)) as policy:
        arm = LeRobotArm(robot, policy.metadata, CAMERAS)
        limits = Limits.read(LIMITS, policy.metadata, settings.hz or policy.metadata["action_hz"])
        recorder = RunRecorder(folder, policy.metadata, settings.instruction, vars(settings))
        report = run_robot(arm, policy, settings, limits, recorder)
        print(f"{report.ticks} ticks, {report.reason}: {report.recording or report.traceback}")


if __name__ == "__main__":
    from lerobot.cameras.opencv import OpenCVCameraConfig
    from lerobot.robots.so101_follower import SO101Follower, SO101FollowerConfig

    eyes = {name: OpenCVCameraConfig(at, 30, 640, 480) for at, name in enumerate(CAMERAS.values())}
    follower = SO101Follower(SO101FollowerConfig(port=sys.argv[1], cameras=eyes, use_degrees=True))
    follower.connect()
    try:
        drive(follower, RunSettings(instruction=sys.argv[2], seconds=60))
    finally:
        follower.disconnect()
