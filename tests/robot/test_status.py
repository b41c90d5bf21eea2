"""The status of a server counts and times its answers."""

import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.robot.status import ConnectedRobot, ServerStatus


def test_quantiles_are_of_the_parts_that_took_any_time(served_policy: Callable[..., Any]) -> None:
    status = ServerStatus(served_policy().metadata)
    robot = ConnectedRobot("here")
    assert json.loads(status.json())["latency"] == {}
    observation: Any = SimpleNamespace(prompt=None)
    for ms in range(1, 1001):
        timing = {"vlm_ms": 0.0, "head_ms": ms, "wait_ms": 0.0, "infer_ms": 2 * ms}
        status.answered(robot, observation, {"server_timing": timing})
    latency = json.loads(status.json())["latency"]
    assert set(latency) == {"head_ms", "infer_ms"}
    np.testing.assert_allclose(
        list(latency["head_ms"].values()), [1000, 500.5, 990.01, 999.001, 1000]
    )
    assert latency["infer_ms"]["p99"] == pytest.approx(1980.02)
