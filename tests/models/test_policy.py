import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from pipeline.config import TrainHeadParams
from pipeline.errors import CheckpointMismatch, ConfigError
from pipeline.models import Policy, PolicyShape, action_groups
from pipeline.normalization import Normalization

BuildPolicy = Callable[..., Policy]
Observe = Callable[..., Any]


def test_act_has_the_chunk_shape_in_physical_units(
    build_policy: BuildPolicy, observe: Observe, normalization: Normalization
) -> None:
    policy = build_policy()
    torch.nn.init.zeros_(policy.expert.head.weight)
    chunk = policy.act(observe())
    mean = torch.tensor(normalization.action.mean, dtype=torch.float32)
    assert not chunk.requires_grad
    torch.testing.assert_close(chunk, mean.expand(4, 8, 7))


def test_loss_normalises_the_target(
    build_policy: BuildPolicy, observe: Observe, normalization: Normalization
) -> None:
    policy, seen = build_policy(), observe()
    torch.nn.init.zeros_(policy.expert.head.weight)
    mean = torch.tensor(normalization.action.mean, dtype=torch.float32).expand(4, 8, 7)
    loss, parts = policy.loss(seen, mean, seen.action_valid)
    assert loss == 0
    assert set(parts) == {"translation", "rotation", "gripper"}


def test_the_target_changes_no_prediction(build_policy: BuildPolicy, observe: Observe) -> None:
    policy, seen = build_policy(), observe()
    predictions = []
    policy.expert.grouped.register_forward_pre_hook(lambda _, args: predictions.append(args[0]))
    policy.loss(seen, seen.action, seen.action_valid)
    policy.loss(seen, 50 * seen.action + 3, ~seen.action_valid)
    said = policy.action_normalizer.normalize(policy.act(seen))
    assert torch.equal(predictions[0], predictions[1])
    torch.testing.assert_close(predictions[0], said, atol=1e-5, rtol=1e-4)


def test_a_constructed_batch_is_learned_to_near_zero(
    build_policy: BuildPolicy, observe: Observe
) -> None:
    policy, seen = build_policy(), observe(batch=8)
    action = policy.action_normalizer.invert(torch.randn(8, 8, 7))
    optimizer = torch.optim.AdamW(policy.parameters(), lr=3e-3, weight_decay=0.0)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 200)
    first = None
    for _ in range(200):
        loss, _ = policy.loss(seen, action, seen.action_valid)
        first = first or loss.item()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    assert loss < 1e-3 * first
    assert (policy.act(seen) - action).abs().max() < 0.1


def test_each_stream_is_heard(build_policy: BuildPolicy, observe: Observe) -> None:
    """Also the newest reading alone, and the age: what closed-loop control lives on."""
    policy, seen = build_policy(), observe()
    before = policy.act(seen)
    for name in ("features", "sensor", "state"):
        louder = getattr(seen, name).clone()
        louder[:, -1] += 3.0
        assert (policy.act(replace(seen, **{name: louder})) - before).abs().max() > 1e-4, name
    older = replace(seen, feature_age=seen.feature_age + 0.3)
    assert (policy.act(older) - before).abs().max() > 1e-4


def test_padding_and_invalid_slots_change_nothing(
    build_policy: BuildPolicy, observe: Observe
) -> None:
    policy, seen = build_policy(), observe()
    seen.sensor_valid = torch.tensor([0, 3, 8, 13])
    seen.state_valid = torch.tensor([0, 3, 8, 25])
    seen.slot_valid[1] = False
    seen.slot_valid[2, 3] = False
    before = policy.act(seen)
    seen.features[1], seen.features[2, 3] = 1e3, 1e3
    for row in range(4):
        seen.sensor[row, : 13 - int(seen.sensor_valid[row])] = 1e3
        seen.state[row, : 25 - int(seen.state_valid[row])] = 1e3
    assert torch.equal(policy.act(seen), before)


def test_gradient_reaches_every_weight_and_every_missing_embedding(
    build_policy: BuildPolicy, observe: Observe
) -> None:
    policy, seen = build_policy(), observe()
    seen.sensor_valid[0] = seen.state_valid[1] = 0
    seen.slot_valid[2] = False
    policy.loss(seen, seen.action, seen.action_valid)[0].backward()
    for name, parameter in policy.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().max() > 0, name


def test_same_seed_same_policy_same_answer(build_policy: BuildPolicy, observe: Observe) -> None:
    seen = observe()
    assert torch.equal(build_policy().act(seen), build_policy().act(seen))


def test_weights_alone_restore_a_policy(build_policy: BuildPolicy, observe: Observe) -> None:
    seen, policy = observe(), build_policy()
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.add_(0.05)
    restored = build_policy()
    restored.load_state_dict(policy.state_dict())
    assert torch.equal(restored.act(seen), policy.act(seen))
    assert set(policy.state_dict()) == {name for name, _ in policy.named_parameters()}


def test_stored_dtypes_are_cast_inside(build_policy: BuildPolicy, observe: Observe) -> None:
    policy, seen = build_policy(), observe()
    exact = policy.act(seen)
    seen.features, seen.sensor = seen.features.bfloat16(), seen.sensor.half()
    torch.testing.assert_close(policy.act(seen), exact, atol=0.02, rtol=0.02)


def test_bf16_autocast_is_near_float32(build_policy: BuildPolicy, observe: Observe) -> None:
    policy, seen = build_policy(), observe()
    seen.sensor_valid[0] = seen.state_valid[0] = 0
    exact, exact_loss = policy.act(seen), policy.loss(seen, seen.action, seen.action_valid)[0]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rough, loss = policy.act(seen), policy.loss(seen, seen.action, seen.action_valid)[0]
    assert rough.dtype == loss.dtype == torch.float32
    torch.testing.assert_close(rough, exact, atol=0.02, rtol=0.02)
    torch.testing.assert_close(loss, exact_loss, atol=0.01, rtol=0.01)
    loss.backward()
    assert all(torch.isfinite(p.grad).all() for p in policy.parameters())


@pytest.mark.parametrize("kept", ["features", "sensor", "robot_state"])
def test_disabled_streams_have_no_encoder_and_no_influence(
    kept: str, build_policy: BuildPolicy, observe: Observe
) -> None:
    switches = {f"{n}_enabled": n == kept for n in ("features", "sensor", "robot_state")}
    policy, seen = build_policy(**switches), observe()
    own = kept.removeprefix("robot_")
    assert [name for name, _ in policy.parameter_table()] == [own, "fusion", "expert"]
    before = policy.act(seen)
    for name in {"features", "sensor", "state"} - {own}:
        setattr(seen, name, getattr(seen, name) + 5)
    assert torch.equal(policy.act(seen), before)


def test_streams_that_the_store_lacks_have_no_encoder(
    shape: PolicyShape,
    normalization: Normalization,
    small_params: Callable[..., TrainHeadParams],
    observe: Observe,
) -> None:
    lacking = replace(shape, sensor_channels=0, state_dim=0)
    policy = Policy(small_params(), lacking, replace(normalization, sensor=None, state=None))
    seen = observe()
    seen.sensor, seen.sensor_valid = torch.zeros(4, 13, 0), torch.zeros(4, dtype=torch.int64)
    seen.state, seen.state_valid = torch.zeros(4, 25, 0), torch.zeros(4, dtype=torch.int64)
    assert list(policy.encoders) == ["features"]
    assert policy.act(seen).shape == (4, 8, 7)


def test_nothing_to_look_at_is_refused(build_policy: BuildPolicy) -> None:
    with pytest.raises(ConfigError, match="5 feature slots, 9 sensor channels"):
        build_policy(features_enabled=False, sensor_enabled=False, robot_state_enabled=False)


def test_statistics_of_another_shape_are_refused(
    shape: PolicyShape,
    normalization: Normalization,
    small_params: Callable[..., TrainHeadParams],
) -> None:
    wider = replace(shape, sensor_channels=10)
    with pytest.raises(CheckpointMismatch, match=r"sensor: expected .* \(10,\), found \(9,\)"):
        Policy(small_params(), wider, normalization)
    with pytest.raises(CheckpointMismatch, match=r"state: .* found None"):
        Policy(small_params(), shape, replace(normalization, state=None))


def test_parameter_table_counts_everything(build_policy: BuildPolicy) -> None:
    policy = build_policy()
    table = policy.parameter_table()
    assert [name for name, _ in table] == ["features", "sensor", "state", "fusion", "expert"]
    assert sum(count for _, count in table) == sum(p.numel() for p in policy.parameters())


def test_shape_survives_json(shape: PolicyShape) -> None:
    assert PolicyShape.from_document(json.loads(json.dumps(shape.document()))) == shape
    with pytest.raises(CheckpointMismatch, match="policy shape"):
        PolicyShape.from_document({"slots": 3})


def test_action_groups_go_by_name_and_unit() -> None:
    names = ["dx", "dalpha", "joint1_velocity", "gripper", "Gripper_width", "mystery", "twist"]
    units = ["mm", "deg", "rad/s", "", "m", "", "mm/s"]
    assert action_groups(names, units) == (
        "translation", "rotation", "other", "gripper", "gripper", "other", "other"
    )  # fmt: skip


def test_wrong_shapes_are_caught_by_the_annotations(
    build_policy: BuildPolicy, observe: Observe
) -> None:
    policy, seen = build_policy(), observe()
    with pytest.raises(Exception, match=r"(?i)type-?check"):
        policy.loss(seen, seen.action[0], seen.action_valid)
