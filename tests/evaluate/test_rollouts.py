"""Rollouts: the same seeds give the same figures, and every controller meets the same episodes."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.base.config import RolloutParams
from pipeline.base.errors import CheckpointMismatch, ConfigError
from pipeline.evaluate.rollout_driver import roll_out
from pipeline.evaluate.rollouts import Rollouts, SuccessRate
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.policy import Policy
from pipeline.simulation.environment import InsertionEnvironment
from pipeline.simulation.insertion import INSTRUCTION, MAX_TICKS, NeedleInsertion
from pipeline.simulation.rendering import VIEWS, photograph
from tests.robot.conftest import SOURCE, Glance, watch
from tests.robot.conftest import build_policy as made

ACTION = SOURCE["streams"]["action"]


def rolled(parts: tuple[PolicyCheckpoint, Policy, Glance], **changed: Any) -> Rollouts:
    checkpoint, policy, glance = parts
    wanted = RolloutParams.model_validate({"episodes": 3, "seed": 77} | changed)
    return roll_out(checkpoint, "models/head", policy, lambda: glance, wanted)


@pytest.fixture(scope="module")
def rollouts() -> Rollouts:
    return rolled(made())


@pytest.fixture(autouse=True)
def brief(rollouts: Rollouts, monkeypatch: pytest.MonkeyPatch) -> None:
    """But for `rollouts`, an episode ends after 2 s."""
    monkeypatch.setattr("pipeline.simulation.insertion.MAX_TICKS", 20)


def test_every_controller_meets_the_same_episodes(rollouts: Rollouts) -> None:
    assert rollouts.controllers == ("policy", "sensor off", "features off", "expert")
    for controller in rollouts.controllers:
        assert [episode.seed for episode in rollouts.of(controller)] == [77, 78, 79]
        for episode in rollouts.of(controller):
            insertion = NeedleInsertion()
            insertion.reset(episode.seed, "full")
            first = insertion.trace().offset_mm[0]
            np.testing.assert_array_equal(episode.trace.offset_mm[0], first)
            assert 1 <= episode.ticks <= MAX_TICKS and episode.ticks == len(episode.trace.time_s)
            assert episode.actions == episode.ticks - 1 and set(episode.frames([0])[0]) == set(
                VIEWS
            )
    assert all(episode.success for episode in rollouts.of("expert"))
    assert {episode.reason for episode in rollouts.of("policy")} != {"inserted"}
    document = rollouts.document()
    assert document["success"] == document["levels"]["full"]
    assert document["success"]["expert"]["rate"] == 1.0
    columns = "seed,level,success,reason,lateral_mm,depth_mm,overshoot_mm,max_force_n,time_s,ticks"
    head, *lines = rollouts.table(policy=True).csv().splitlines()
    assert head == columns and len(lines) == 3
    head, *lines = rollouts.table(policy=False).csv().splitlines()
    assert head == f"controller,{columns}" and len(lines) == 3 * 3


def test_an_episode_is_the_same_alone_as_among_others() -> None:
    """So that one that failed can be looked at again by its seed."""
    settings = {"chunking": "rtc", "execute": 2, "ablations": ()}
    among = rolled(made("flow_matching"), **settings, episodes=2)
    alone = rolled(made("flow_matching"), **settings, episodes=1, seed=78)
    there, here = among.of("policy")[1], alone.of("policy")[0]
    assert (there.seed, there.ticks, there.reason) == (here.seed, here.ticks, here.reason)
    np.testing.assert_allclose(there.trace.offset_mm, here.trace.offset_mm, atol=1e-3)


def test_robots_share_a_pass_of_the_model_and_are_told_the_task() -> None:
    parts = made()
    fresh = rolled(parts, ablations=())
    glance = parts[2]
    assert len(glance.passes[0]) == 3
    longest = max(episode.ticks for episode in fresh.of("policy"))
    assert len(glance.passes) == -(-(longest - 1) // 3)
    assert set(glance.instructions) == {INSTRUCTION}
    # What the model sees has been through the recorder's JPEG.
    robot = InsertionEnvironment("full")
    robot.reset(seed=77)
    for view, (time, frame) in robot.frames().items():
        np.testing.assert_array_equal(glance.passes[0][0][view], frame)
        assert not np.array_equal(frame, photograph(view, robot.insertion, time))


def test_the_model_gets_the_views_and_the_task_that_the_policy_was_trained_on() -> None:
    checkpoint, policy, glance = made(views=2)
    streams = SOURCE["streams"] | {"views": ["View2", "View5"]}
    told = replace(checkpoint, source=SOURCE | {"streams": streams}, instructions=("Go there",))
    rollouts = rolled((told, policy, glance), episodes=1, ablations=())
    assert {tuple(views) for frames in glance.passes for views in frames} == {("View2", "View5")}
    assert set(glance.instructions) == {"Go there"} == {rollouts.settings["instruction"]}
    several = replace(checkpoint, instructions=("Go there", "Stay"))
    with pytest.raises(ConfigError, match="'Go there', 'Stay'"):
        rolled((several, policy, glance), episodes=1)


@pytest.mark.parametrize("latency_ms", [0, 400])
def test_what_the_policy_sees_is_as_old_as_it_says(latency_ms, monkeypatch):
    parts = made()
    given = watch(monkeypatch, parts[1])
    rolled(parts, ablations=(), episodes=1, latency_ms=latency_ms)
    ages = [float(streams["feature_age"][0]) for streams in given]
    # Cameras run at 10 Hz, passes begin every third tick or when the model is free.
    latency_s = latency_ms / 1000
    assert latency_s < min(ages) and max(ages) < latency_s + 0.33 + latency_s
    assert np.ptp(ages) > 0.15


def test_several_latencies_are_rolled_out_in_the_same_episodes() -> None:
    several = rolled(made(), ablations=["state off"], episodes=2, latency_ms=[300, 0, 300])
    assert several.controllers == ("policy", "0 ms late", "state off", "expert")
    late, on_time = (rolled(made(), ablations=(), episodes=2, latency_ms=ms) for ms in (300, 0))
    assert several.table(policy=True).csv() == late.table(policy=True).csv()
    for one, same in zip(several.of("0 ms late"), on_time.of("policy"), strict=True):
        np.testing.assert_array_equal(one.trace.offset_mm, same.trace.offset_mm)
    rates = several.document()["latency_ms"]
    assert list(rates) == ["0", "300"]
    assert rates["300"] == several.document()["success"]["policy"]
    assert not np.array_equal(late.of("policy")[0].trace.offset_mm, one.trace.offset_mm)


def test_a_stream_that_is_off_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint, policy, glance = made()
    normal = checkpoint.normalization
    spread = {
        name: replace(getattr(normal, name), mean=np.full(policy.shape.channels[name], 0.25))
        for name in ("sensor", "features")
    }
    checkpoint = replace(checkpoint, normalization=replace(normal, **spread))
    given = watch(monkeypatch, policy)
    rollouts = rolled((checkpoint, policy, glance), episodes=1)
    # The model makes no pass for features that nobody sees.
    ticks = [rollouts.of(controller)[0].ticks for controller in ("policy", "sensor off")]
    assert len(glance.passes) == sum(-(-(count - 1) // 3) for count in ticks)
    for stream, other in (("sensor", "features"), ("features", "sensor")):
        silent = [seen for seen in given if (seen[stream] == 0.25).all()]
        assert len(silent) > 5
        assert all(seen[other].any() and not (seen[other] == 0.25).all() for seen in silent)
        assert len({tuple(seen["feature_age"]) for seen in silent}) > 3
        assert all(seen["slot_valid"].all() and seen["feature_age"].max() < 0.4 for seen in silent)


def test_streams_that_a_policy_lacks_are_passed_over() -> None:
    parts = made(features_enabled=False)
    rollouts = rolled(parts, episodes=1, ablations=("features off", "state off"))
    assert rollouts.controllers == ("policy", "state off", "expert")
    # One whose store lacks sensor and state, so that they have no channels.
    checkpoint, _, glance = made()
    shape = replace(checkpoint.shape, sensor_channels=0, state_dim=0)
    normal = replace(checkpoint.normalization, sensor=None, state=None)
    policy = Policy(checkpoint.params, shape, normal).eval()
    without = replace(checkpoint, shape=shape, normalization=normal)
    assert len(rolled((without, policy, glance), episodes=1).of("policy")) == 1


def test_an_action_that_is_no_number_stops_its_robot_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = made()
    act, calls = parts[1].act, []

    def broken(*arguments: Any) -> torch.Tensor:
        chunks = act(*arguments).clone()
        calls.append(len(chunks))
        if len(calls) == 4:
            chunks[1, 0, 0] = np.nan
        return chunks

    monkeypatch.setattr(parts[1], "act", broken)
    rollouts = rolled(parts, ablations=())
    reasons = [episode.reason for episode in rollouts.of("policy")]
    assert reasons[1] == "safe stop: the policy's action is not a number"
    assert not any(reason.startswith("safe stop") for reason in (reasons[0], reasons[2]))
    assert [episode.ticks for episode in rollouts.of("policy")][1] == 4
    assert calls[3:5] == [3, 2]


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ({"streams": {"action": ACTION, "views": ["View1", "View4"]}}, "View4"),
        ({"streams": {"action": ACTION | {"kind": "absolute"}, "views": []}}, "absolute"),
    ],
)
def test_a_policy_of_another_robot_is_refused(source: dict[str, Any], said: str) -> None:
    checkpoint, policy, glance = made()
    other = replace(checkpoint, source=SOURCE | source)
    with pytest.raises(CheckpointMismatch, match=said):
        rolled((other, policy, glance))
    with pytest.raises(ConfigError, match=r"rollout\.chunking"):
        rolled((checkpoint, policy, glance), chunking="rtc")
    assert not glance.passes


def test_intervals_are_wilsons() -> None:
    """Newcombe 1998, Table I, method 3."""
    for successes, episodes, ends in ((81, 263, (0.2553, 0.3662)), (0, 20, (0, 0.1611))):
        rate = SuccessRate.of([index < successes for index in range(episodes)])
        assert (rate.low, rate.high) == pytest.approx(ends, abs=6e-5)


def test_the_model_proves_itself_before_the_first_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = made()

    def refuse(checkpoint: PolicyCheckpoint, features: Any, say: Any) -> None:
        assert (checkpoint, features) == (parts[0], parts[2])
        raise CheckpointMismatch("golden rows are not the features")

    monkeypatch.setattr("pipeline.evaluate.rollout_driver.prove", refuse)
    with pytest.raises(CheckpointMismatch, match="golden rows"):
        rolled(parts)
    assert not parts[2].passes
