"""The client says clearly what is wrong, and needs three packages."""

import os
import re
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.base.errors import CheckpointMismatch, ObservationError, ServerError
from pipeline.robot.client import PolicyClient, refuse_other_robot
from tests.robot.conftest import Blocked

ROOT = Path(__file__).resolve().parents[2]

LIGHT = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        allowed = {"numpy", "msgpack", "websockets", "pipeline"} | sys.stdlib_module_names
        if name.partition(".")[0] not in allowed:
            raise ImportError(f"{name} is not on the robot's computer")

sys.meta_path.insert(0, refuse := Refuse())
from pipeline.robot.client import PolicyClient
from pipeline.robot.loop import Executor
print(sorted({name.partition(".")[0] for name in sys.modules} & {"numpy", "msgpack", "websockets"}))
sys.meta_path.remove(refuse)
import pipeline.robot.lerobot_arm, pipeline.robot.realtime, pipeline.robot.recorder
print("torch" in sys.modules)
"""


def test_it_needs_numpy_msgpack_and_websockets_alone_and_running_a_robot_no_torch() -> None:
    """And so does the executor, which plays what it gets."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", LIGHT],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "['msgpack', 'numpy', 'websockets']\nFalse\n"


def test_a_reset_goes_with_the_next_observation(served_policy, serving, observe) -> None:
    with PolicyClient(f"ws://{serving(served_policy('flow_matching')).address}") as client:
        client.reset(5)
        first = [client.infer(observe(tick))["actions"] for tick in (0, 1)]
        client.reset(5)
        np.testing.assert_array_equal(client.infer(observe(0))["actions"], first[0])
        np.testing.assert_array_equal(client.infer(observe(1))["actions"], first[1])
        client.reset()
        assert not np.array_equal(client.infer(observe(0))["actions"], first[0])


def test_a_refused_observation_says_why_and_closes_the_connection(served_policy, serving, observe):
    with PolicyClient(serving(served_policy()).address) as client:
        with pytest.raises(ObservationError, match=r"^sensors: expected one of.* sensor"):
            client.infer(observe(0, sensors=np.zeros(3)))
        with pytest.raises(ServerError, match="the connection is closed"):
            client.infer(observe(0))


def test_nobody_listens_or_something_else_does() -> None:
    """What takes the connection and says nothing, among it."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        with pytest.raises(ServerError, match=r"nobody serves a policy there .timed out"):
            PolicyClient(f"ws://127.0.0.1:{port}", timeout_s=0.1)
    with pytest.raises(ServerError, match=r"nobody serves a policy there.*Start python -m stages"):
        PolicyClient(f"127.0.0.1:{port}")
    with pytest.raises(ServerError, match="expected an address such as ws://"):
        PolicyClient("http://127.0.0.1:1")


def test_a_late_answer_is_never_taken_for_the_next(served_policy, serving, observe) -> None:
    served = served_policy()
    blocked = Blocked(served)
    with PolicyClient(f"ws://{serving(served).address}", timeout_s=60) as client:
        client._timeout_s = 0.1  # of this answer alone, which does not come
        with pytest.raises(ServerError, match=r"expected an answer within 0\.1 s"):
            client.infer(observe(0))
        blocked.go.set()
        with pytest.raises(ServerError, match="the connection is closed"):
            client.infer(observe(7))


METADATA = {
    "streams": {
        "state": {"names": ["a", "b", "c"], "units": ["deg", "deg", "mm"]},
        "sensor": {"names": [], "units": []},
        "action": {"names": ["dx", "dy"], "units": ["mm", "mm"], "kind": "delta"},
        "views": ["View1", "View2"],
    },
    "action_hz": 10.0,
}


@pytest.mark.parametrize(
    ("robot", "said"),
    [
        ({"state": ["b", "a", "c"]}, 'state: ["a", "b", "c"] in training, the robot\'s ["b"'),
        ({"views": ["View2"]}, 'views: ["View1", "View2"] in training, the robot\'s ["View2"]'),
        ({"action_hz": 30}, "action_hz: 10.0 in training, the robot's 30"),
        ({"camera": ["View1"]}, "the robot's description: expected views, "),
    ],
)
def test_another_robot_is_refused_with_both_sides_named(robot: dict[str, Any], said: str) -> None:
    with pytest.raises(CheckpointMismatch, match=re.escape(said)):
        refuse_other_robot(robot, METADATA)


def test_the_policys_own_robot_is_not_refused() -> None:
    """It may have more views, in another order."""
    refuse_other_robot({}, METADATA)
    own = {"state": ("a", "b", "c"), "sensor": [], "action_kind": "delta", "action_hz": 10}
    refuse_other_robot(own | {"views": ["View2", "View1", "View7"]}, METADATA)
