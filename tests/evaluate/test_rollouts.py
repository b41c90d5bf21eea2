"""Rollouts: the same seeds give the same figures, and every controller meets the same episodes."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.base.config import RolloutParams, TrainHeadParams
from pipeline.base.errors import CheckpointMismatch, ConfigError
from pipeline.compat.unified import no_normalization
from pipeline.evaluate.rollouts import LivePart, RolloutEpisode, Rollouts, SuccessRate, roll_out
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.observation import PolicyShape
from pipeline.policy.policy import Policy
from pipeline.simulation.insertion import MAX_TICKS, NeedleInsertion
from pipeline.simulation.rendering import VIEWS

SLOTS, DIM = 2, 4
ACTION = {
    "names": ["dx", "dy", "dz", "rx", "ry", "rz", "gripper"],
    "units": ["mm"] * 3 + ["deg"] * 3 + [""],
    "kind": "delta",
}
SOURCE = {
    "feature_spec": {"views": list(VIEWS)},
    "streams": {"action": ACTION, "views": list(VIEWS)},
    "action_hz": 10.0,
    "vlm_reuse_count": 3,
}


class Glance:
    """Stands for the model: features that are the means of the frames; counts its passes."""

    def __init__(self) -> None:
        self.passes: list[int] = []

    def __call__(self, frames: list[dict[str, Any]], instruction: str) -> Any:
        self.passes.append(len(frames))
        means = [[frame[..., channel].mean() / 255 for channel in range(3)] for views in frames
                 for frame in list(views.values())[:SLOTS]]  # fmt: skip
        features = torch.zeros(len(frames), SLOTS, DIM)
        features[..., :3] = torch.tensor(np.array(means)).view(-1, SLOTS, 3)
        return features, torch.ones(len(frames), SLOTS, dtype=torch.bool)


def made(model_type: str = "regression", **changed: Any) -> tuple[PolicyCheckpoint, LivePart]:
    """A policy of few random weights, and what a rollout runs of it."""
    params = TrainHeadParams.model_validate(
        {
            "model_type": model_type,
            "horizon": 4,
            "sensor_window": 10,
            "state_window": 10,
            "sensor_encoder": {"channels": [8], "layers": 0, "heads": 1, "output_dim": 8},
            "state_encoder": {"dim": 8, "layers": 0, "heads": 1, "output_dim": 8},
            "expert": {"dim": 8, "layers": 1, "heads": 1},
        }
        | changed
    )
    shape = PolicyShape(
        SLOTS, DIM, 1026, 12, 7, ("translation",) * 3 + ("rotation",) * 3 + ("gripper",)
    )
    normal = no_normalization(shape)
    # So that a random policy moves by tenths of a millimetre.
    action = replace(normal.action, std=np.full(7, 0.05), mean=np.array([0, 0, -0.1, 0, 0, 0, 1.0]))
    normal = replace(normal, action=action)
    torch.manual_seed(0)
    policy = Policy(params, shape, normal).eval()
    held = {"held_out_ticks": {}, "held_out_content": {}, "step": 1, "weights": {}}
    checkpoint = PolicyCheckpoint(params, shape, normal, SOURCE, **held)
    features: Any = Glance()
    return checkpoint, LivePart(policy, features, 3, normal)


def wanted(**changed: Any) -> RolloutParams:
    return RolloutParams.model_validate({"episodes": 3, "seed": 77} | changed)


def figures(rollouts: Rollouts) -> list[Any]:
    return [rollouts.document(), rollouts.table().csv()]


@pytest.fixture(scope="module")
def rollouts() -> Rollouts:
    return roll_out(*parts(made()), wanted())


def parts(pair: tuple[PolicyCheckpoint, LivePart]) -> tuple[PolicyCheckpoint, str, LivePart]:
    return pair[0], "models/head", pair[1]


def test_every_controller_meets_the_same_episodes(rollouts: Rollouts) -> None:
    assert rollouts.controllers == ("policy", "sensor off", "features off", "expert")
    for controller in rollouts.controllers:
        assert [episode.seed for episode in rollouts.of(controller)] == [77, 78, 79]
        for episode in rollouts.of(controller):
            insertion = NeedleInsertion()
            insertion.reset(episode.seed, "full")
            first = insertion.trace()
            np.testing.assert_array_equal(episode.trace.offset_mm[0], first.offset_mm[0])
            assert 1 <= episode.ticks <= MAX_TICKS and episode.ticks == len(episode.trace.time_s)
            assert set(episode.frames(0.3)) == set(VIEWS)
    assert all(episode.success for episode in rollouts.of("expert"))
    assert {episode.reason for episode in rollouts.of("policy")} != {"inserted"}


@pytest.mark.parametrize("model_type", ["regression", "flow_matching", "diffusion"])
@pytest.mark.parametrize("chunking", ["none", "temporal", "rtc"])
def test_same_seeds_same_figures(model_type: str, chunking: str) -> None:
    settings = wanted(chunking=chunking, execute=2, ablations=False, episodes=2)
    if chunking == "rtc" and model_type == "regression":
        with pytest.raises(ConfigError, match=r"rollout\.chunking"):
            roll_out(*parts(made(model_type)), settings)
        return
    first, again = (roll_out(*parts(made(model_type)), settings) for _ in range(2))
    assert figures(first) == figures(again)
    elsewhere = roll_out(*parts(made(model_type)), wanted(seed=500, episodes=2, ablations=False))
    assert figures(first)[1] != figures(elsewhere)[1]


def test_robots_share_a_pass_of_the_model_and_old_features_change_what_is_done() -> None:
    checkpoint, live = made()
    fresh = roll_out(checkpoint, "x", live, wanted(ablations=False))
    assert isinstance(live.features, Glance) and live.features.passes[0] == 3
    longest = max(episode.ticks for episode in fresh.of("policy"))
    assert len(live.features.passes) == -(-(longest - 1) // 3)
    late = roll_out(*parts(made()), wanted(ablations=False, latency_ms=400))
    assert figures(fresh)[1] != figures(late)[1]


def test_an_action_that_is_no_number_stops_its_robot_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint, live = made()
    act, calls = live.policy.act, []

    def broken(*arguments: Any) -> torch.Tensor:
        chunks = act(*arguments).clone()
        calls.append(len(chunks))
        if len(calls) == 4:
            chunks[1, 0, 0] = np.nan
        return chunks

    monkeypatch.setattr(live.policy, "act", broken)
    rollouts = roll_out(checkpoint, "x", live, wanted(ablations=False))
    reasons = [episode.reason for episode in rollouts.of("policy")]
    assert reasons[1] == "safe stop: the policy's action is not a number"
    assert not any(reason.startswith("safe stop") for reason in (reasons[0], reasons[2]))
    assert [episode.ticks for episode in rollouts.of("policy")][1] == 4
    assert calls[3:5] == [3, 2]


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ({"action_hz": 30.0}, "action_hz 30"),
        ({"streams": {"action": ACTION, "views": ["View1", "View4"]}}, "View4"),
        ({"streams": {"action": ACTION | {"kind": "absolute"}, "views": []}}, "absolute"),
    ],
)
def test_a_policy_of_another_robot_is_refused(source: dict[str, Any], said: str) -> None:
    checkpoint, live = made()
    other = replace(checkpoint, source=SOURCE | source)
    with pytest.raises(CheckpointMismatch, match=said):
        roll_out(other, "x", live, wanted())


def test_intervals_are_wilsons(rollouts: Rollouts) -> None:
    episode = rollouts.of("policy")[0]

    def rate(successes: int, episodes: int) -> SuccessRate:
        these: list[RolloutEpisode] = [
            replace(episode, success=index < successes) for index in range(episodes)
        ]
        return SuccessRate.of(these)

    # Newcombe 1998, Table I, method 3.
    known = {(81, 263): (0.2553, 0.3662), (15, 148): (0.0624, 0.1605), (0, 20): (0, 0.1611),
             (29, 29): (0.8830, 1.0)}  # fmt: skip
    for (successes, episodes), (low, high) in known.items():
        interval = rate(successes, episodes)
        assert (interval.low, interval.high) == pytest.approx((low, high), abs=6e-5)


def test_metrics_and_table_say_the_same(rollouts: Rollouts) -> None:
    document, lines = rollouts.document(), rollouts.table().csv().splitlines()
    assert document["success"] == document["levels"]["full"]
    assert document["success"]["expert"]["rate"] == 1.0
    assert len(lines) == 1 + 4 * 3
    assert lines[0].startswith("controller,seed,level,success,reason,lateral_mm,depth_mm,")
    assert lines[0].endswith(",overshoot_mm,max_force_n,time_s,ticks")
