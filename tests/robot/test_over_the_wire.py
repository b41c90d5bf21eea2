"""Rollouts over the wire are those in process, and what cannot be the same is refused."""

import json
from contextlib import closing
from typing import Any, ClassVar

import numpy as np
import pytest

from pipeline.base.config import RolloutParams, Source
from pipeline.data import open_recordings
from pipeline.evaluate.rollout_driver import roll_out, roll_out_served
from pipeline.evaluate.rollouts import Rollouts
from pipeline.robot.client import PolicyClient
from pipeline.robot.loop import StopKind
from pipeline.robot.realtime import RunSettings, run_robot
from pipeline.robot.recorder import RunRecorder
from pipeline.simulation.environment import SimulatedRobot
from pipeline.simulation.insertion import INSTRUCTION


def over_the_wire(served: Any, serving: Any, **changed: Any) -> Rollouts:
    wanted = RolloutParams.model_validate({"episodes": 1, "seed": 77} | changed)
    with PolicyClient(f"ws://{serving(served).address}") as client:
        return roll_out_served(client, wanted)


@pytest.mark.parametrize(
    ("model_type", "changed"),
    [
        ("regression", {"chunking": "temporal", "level": "moved", "latency_ms": [400, 100]}),
        ("flow_matching", {"chunking": "rtc"}),
    ],
)
def test_the_same_seed_gives_the_same_episode_bit_for_bit(
    model_type, changed, served_policy, serving
):
    served = served_policy(model_type)
    wired = over_the_wire(served, serving, **changed)
    alone = RolloutParams.model_validate({"episodes": 1, "seed": 77, "ablations": []} | changed)
    here = roll_out(served.checkpoint, "models/head", served.policy, lambda: served.glance, alone)
    assert wired.document() == here.document()
    for policy in (True, False):
        assert wired.table(policy).csv() == here.table(policy).csv()
    for name, values in vars(here.episodes[0].trace).items():
        assert (getattr(wired.episodes[0].trace, name) == values).all(), name


def test_several_steps_of_a_chunk_are_played_between_two_questions(served_policy, serving) -> None:
    served = served_policy()
    wired = over_the_wire(served, serving, execute=2)
    steps = wired.of("policy")[0].ticks - 1  # the first tick is over when the episode begins
    # Frames go along with a question once `vlm_reuse_count` ticks lie between: every fourth tick.
    assert len(served.glance.passes) == -(-steps // 4)


def test_a_run_in_real_time_over_the_wire_is_recorded(served_policy, serving, tmp_path) -> None:
    """As docs/robot.md says it, with a model that is a stand-in, until five actions are sent."""

    class Arm(SimulatedRobot):
        acts: ClassVar[list[np.ndarray]] = []

        def observe(self) -> dict[str, Any]:
            ended = {"ended": "five actions"} if len(self.acts) == 5 else {}
            return super().observe() | ended

        def act(self, action: np.ndarray) -> None:
            super().act(action)
            self.acts.append(action)

    served = served_policy()
    robot = Arm(seed=78)
    address = serving(served, fresh=False).address
    with PolicyClient(f"ws://{address}", timeout_s=60) as policy, closing(robot):
        settings = RunSettings(
            INSTRUCTION, clock_drift_s=60, old_features_s=60, old_frame_s=60, stalled_s=60,
            missed_in_a_row=10**6, hung_s=60,
        )  # fmt: skip
        recorder = RunRecorder(tmp_path, policy.metadata, INSTRUCTION, vars(settings))
        report = run_robot(robot, policy, settings, recorder=recorder)
    assert report.kind is StopKind.ENDED, report.reason
    assert report.answers > 0
    assert report.recording == tmp_path / "run_000000"
    run = json.loads((report.recording / "run.json").read_text())
    assert run["rows"] == 5 and run["metadata"]["step"] == 1
    (recording,) = open_recordings([Source(name="runs", path=str(report.recording))]).recordings
    np.testing.assert_array_equal(recording.action().values, np.float32(robot.acts))
