"""A robot that params name is driven, stopped by its limits, and recorded each time."""

import signal
import sys
import textwrap
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from pipeline.base.config import DriveParams, Params, Source
from pipeline.base.errors import CheckpointMismatch, ConfigError, RobotStopped
from pipeline.data import open_recordings
from pipeline.robot.drive import drive, make_robot
from pipeline.robot.lerobot_arm import LeRobotArm

LEROBOT = """
    import numpy as np
    from lerobot.robots import RobotConfig

    class Arm:
        ARMS = []

        def __init__(self, config):
            self.config, self.state, self.log = config, dict.fromkeys(config["joints"], 0.0), []
            Arm.ARMS.append(self)

        action_features = property(lambda self: dict.fromkeys(self.config["motors"], float))
        observation_features = property(
            lambda self: {
                **dict.fromkeys([*self.state, *self.config["motors"]], float),
                **dict.fromkeys(self.config["views"], (4, 6, 3)),
            }
        )

        def connect(self):
            self.log.append("connect")

        def disconnect(self):
            self.log.append("disconnect")

        def get_observation(self):
            self.log.append("observe")
            frame = np.full((4, 6, 3), len(self.log) % 251, np.uint8)
            motors = dict.fromkeys(self.config["motors"], 0.0)
            return {**self.state, **motors, **dict.fromkeys(self.config["views"], frame)}

        def send_action(self, action):
            self.log.append("act")
            return action

    RobotConfig.made_by["fake_arm"] = Arm
"""
FILES = {
    "draccus/__init__.py": """
        from types import SimpleNamespace

        class DecodingError(Exception):
            pass

        utils = SimpleNamespace(DecodingError=DecodingError)

        def decode(kinds, fields):
            if fields["type"] not in kinds.made_by:
                raise DecodingError(f"no {fields['type']}")
            return fields
    """,
    "lerobot/__init__.py": "",
    "lerobot/cameras/__init__.py": "",
    "lerobot/robots/__init__.py": """
        class RobotConfig:
            made_by = {}
            get_known_choices = classmethod(lambda cls: cls.made_by)
    """,
    "lerobot/robots/utils.py": """
        from lerobot.robots import RobotConfig

        def make_robot_from_config(config):
            return RobotConfig.made_by[config["type"]](config)
    """,
    "lerobot/robots/fake_arm.py": LEROBOT,
    "lerobot/robots/undriven.py": "import drivers_that_are_not_installed",
}


@pytest.fixture
def lerobot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A package with LeRobot's names: its registry of configs, and one arm."""
    for name, text in FILES.items():
        (tmp_path / "site" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "site" / name).write_text(textwrap.dedent(text), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path / "site")
    yield
    for name in [name for name in sys.modules if name.split(".")[0] in ("lerobot", "draccus")]:
        del sys.modules[name]


@pytest.fixture
def driven(served_policy, simulated_time, tmp_path, monkeypatch) -> Callable[..., Any]:
    """`driven(limits, key=value, ...)`: drives the fake arm; its report and what was said."""
    served = served_policy()
    monkeypatch.setattr("pipeline.robot.session.ServedPolicy.load", lambda *_: served)
    on_its_clock = partial(LeRobotArm, clock_s=simulated_time.monotonic)
    monkeypatch.setattr("pipeline.robot.drive.LeRobotArm", on_its_clock)
    streams = served.metadata["streams"]
    config = {
        "joints": list(streams["state"]["names"]),
        "motors": [f"{name}.pos" for name in streams["action"]["names"]],
        "views": list(streams["views"]),
    }

    def run(limits: str = "", **changed: Any) -> tuple[Any, list[str]]:
        path = tmp_path / "limits.yaml"
        path.write_text(limits, encoding="utf-8")
        section = {
            "robot": "lerobot:fake_arm",
            "robot_args": config,
            "limits": str(path) if limits else None,
            "runs": str(tmp_path / "runs"),
            "seconds": 3,
            "settings": {"watch": ["state"]},
        }
        data = {"sources": [{"name": "demo", "path": "demo"}]}
        params = Params.model_validate(
            {"data": data, "vlm": {"checkpoint": "none"}, "drive": section | changed}
        )
        said: list[str] = []
        return drive(params, said.append), said

    return run


def test_an_arm_is_driven_recorded_and_disconnected(lerobot, driven, tmp_path):
    report, said = driven("step: {most: {translation: 100}}")
    arm = sys.modules["lerobot.robots.fake_arm"].Arm.ARMS[-1]
    assert (arm.log[0], arm.log[-1]) == ("connect", "disconnect")
    assert report.ticks == 30 and arm.log.count("act") >= 25 and report.answers > 5
    source = Source(name="runs", path=str(tmp_path / "runs"))
    (recording,) = open_recordings([source]).recordings
    assert len(recording.action().time) == arm.log.count("act") - 1  # the last holds it still
    assert any("recording: " in line for line in said) and said[-1].startswith("time is up")


def test_a_limit_stops_the_arm_and_the_run_is_kept(lerobot, driven, tmp_path):
    with pytest.raises(RobotStopped, match="outside the workspace"):
        driven("workspace: {box: {joint_3: [1.0, 2.0]}}")
    assert sys.modules["lerobot.robots.fake_arm"].Arm.ARMS[-1].log[-1] == "disconnect"
    assert [path.name for path in (tmp_path / "runs").glob("run_*")] == ["run_000000"]


def test_an_arm_that_cannot_be_disconnected_does_not_hide_why_it_stopped(
    lerobot, driven, monkeypatch
):
    def pulled(self: Any) -> None:
        raise ConnectionError("no answer on the bus")

    monkeypatch.setattr(import_module("lerobot.robots.fake_arm").Arm, "disconnect", pulled)
    report, said = driven()
    assert said[-1].startswith("time is up") and report.recording is not None
    assert any("drive.limits" in line for line in said), "without limits it warns"
    assert any("was not disconnected (no answer on the bus)" in line for line in said)


def test_a_second_ctrl_c_does_not_cut_the_disconnection(lerobot, driven, monkeypatch):
    left: list[str] = []

    def disconnect(self: Any) -> None:
        signal.raise_signal(signal.SIGINT)
        left.append("torque off")

    monkeypatch.setattr(import_module("lerobot.robots.fake_arm").Arm, "disconnect", disconnect)
    _, said = driven()
    assert left == ["torque off"] and not any("not disconnected" in line for line in said)


def test_what_cannot_be_driven_is_refused_by_its_key(lerobot, driven):
    wrong: dict[str, dict[str, Any]] = {
        "drive.robot: expected module:Class": {"robot": "arm"},
        "drive.robot: no_such:Arm": {"robot": "no_such:Arm"},
        "LeRobot has fake_arm": {"robot": "lerobot:so_1001"},
        "drive.robot_args": {"robot": "fractions:Fraction", "robot_args": {"sed": 1}},
        "drive.settings.old_features_s": {"settings": {"old_features_s": "soon"}},
        "drive.settings: expected instruction": {"settings": {"old_features": 1}},
        "drive.settings.execute: expected 1 to": {"settings": {"execute": 99}},
        "drive.settings.chunking: .*found rtc": {"settings": {"chunking": "rtc"}},
    }
    for place, changed in wrong.items():
        with pytest.raises(ConfigError, match=place):
            driven(**changed)


def test_the_default_robot_is_the_simulated_arm() -> None:
    robot = make_robot(DriveParams().robot, {"seed": 3})
    assert robot.observe()["state"].shape[1] == 12
    robot.close()


def test_a_class_of_the_current_folder_is_found_and_its_description_compared(
    driven, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    text = (
        "class Arm:\n    def __init__(self, hz=1):\n        self.description = {'action_hz': hz}\n"
    )
    (tmp_path / "own_arm.py").write_text(text, encoding="utf-8")
    assert make_robot("own_arm:Arm", {"hz": 7}).description == {"action_hz": 7}
    with pytest.raises(CheckpointMismatch, match="action_hz"):
        driven(robot="own_arm:Arm", robot_args={"hz": 7})
