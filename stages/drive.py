"""Drive a robot with a trained policy, within limits, and record the run.

The robot is `drive.robot`: a class of yours, an arm of an installed LeRobot, or the simulated arm,
which is the default. The policy is what stages.train_head wrote to train_head.output, in this
process, or what a running stages.serve serves (--server). Ctrl-C stops the robot. The run is kept
as a LeRobot data set in drive.runs. The exit code is 0 after a normal end, 2 after a safe stop,
whose reason is printed.

  python -m stages.drive --limits examples/limits.yaml         the simulated arm
  python -m stages.drive --robot my_arm:Arm --instruction "Insert the needle"
  python -m stages.drive --robot lerobot:so101_follower --server ws://192.168.1.5:8000 \\
      --set 'drive.robot_args={port: /dev/ttyACM0}'

Next: python -m stages.inspect runs
"""

from functools import partial
from typing import TYPE_CHECKING

from stages.command import Shorthand, run, short

if TYPE_CHECKING:
    from pipeline.base.config import Params

SECTIONS = ("drive",)
SHORTHANDS = (
    *short("drive", "--checkpoint", "--device"),
    Shorthand("--robot", "drive.robot", "module:Class or lerobot:TYPE", "NAME"),
    Shorthand("--server", "drive.server", "address of a running stages.serve", "URL"),
    Shorthand("--instruction", "drive.instruction", "what the robot is to do", "TEXT"),
    Shorthand("--limits", "drive.limits", "YAML file of limits", "FILE"),
    Shorthand("--seconds", "drive.seconds", "how long", "S"),
)


def main(params: "Params") -> None:
    """Run the robot of `drive` until something ends the run."""
    from pipeline.robot.drive import drive

    drive(params, partial(print, flush=True))


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))
