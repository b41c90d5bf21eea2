from dataclasses import replace

import pytest
import torch

from pipeline.base.errors import ConfigError
from pipeline.policy.expert import Guide
from pipeline.policy.observation import moving_channels
from pipeline.policy.policy import Policy, Trainable, describe_size, drop_streams

KINDS = [
    ("regression", "concat"),
    ("diffusion", "cross_attention"),
    ("flow_matching", "gated"),
    ("regression", "none"),
]


def seeded(seed: int = 5) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture(params=KINDS, ids="-".join)
def any_policy(request, build_policy):
    """Every expert, every fusion, the sensor's two encoders."""
    expert, fusion = request.param
    kind = "joint" if KINDS.index(request.param) % 2 else "force_aware"
    sensor = {"kind": kind, "channels": [16, 32], "layers": 1, "heads": 2, "output_dim": 24}
    steps = {"sampling_steps": 3}
    policy = build_policy(
        model_type=expert,
        fusion_strategy=fusion,
        sensor_encoder=sensor,
        diffusion=steps,
        flow_matching=steps,
    )
    # Experts may begin with weights of zero; an answer that ignores the context tests nothing.
    with torch.no_grad():
        for parameter in policy.expert.parameters():
            if not parameter.any():
                parameter.normal_(std=0.02)
    return policy


class TestEveryKind:
    def test_it_is_trainable_and_its_chunks_are_physical(self, any_policy, observe):
        assert isinstance(any_policy, Trainable)
        seen = observe()
        chunks = any_policy.sample(seen, 3, seeded())
        assert torch.equal(any_policy.act(seen, seeded()), any_policy.act(seen, seeded()))
        assert chunks.shape == (3, 4, 8, 7)
        assert chunks.dtype == torch.float32
        assert not chunks.requires_grad
        differ = bool((chunks[0] != chunks[1]).any())
        assert differ == any_policy.stochastic

    def test_the_context_is_computed_once(self, any_policy, observe):
        calls = []
        any_policy.fusion.register_forward_hook(lambda *_: calls.append(1))
        any_policy.sample(observe(), 5, seeded())
        assert len(calls) == 1

    def test_each_stream_and_the_age_are_heard(self, any_policy, observe):
        seen = observe()
        before = any_policy.act(seen, seeded())
        for name in ("features", "sensor", "state"):
            louder = getattr(seen, name).clone()
            louder[:, -1] += 3.0
            after = any_policy.act(replace(seen, **{name: louder}), seeded())
            assert (after - before).abs().max() > 1e-4, name
        older = replace(seen, feature_age=seen.feature_age + 0.3)
        assert (any_policy.act(older, seeded()) - before).abs().max() > 1e-5

    def test_padding_and_invalid_slots_change_nothing(self, any_policy, observe):
        seen = observe()
        seen.sensor_valid = torch.tensor([0, 3, 8, 13])
        seen.state_valid = torch.tensor([0, 3, 8, 25])
        seen.slot_valid[1] = False
        seen.slot_valid[2, 3] = False
        before = any_policy.act(seen, seeded())
        seen.features[~seen.slot_valid] = torch.nan
        for row in range(4):
            seen.sensor[row, : 13 - int(seen.sensor_valid[row])] = torch.nan
            seen.state[row, : 25 - int(seen.state_valid[row])] = torch.nan
        assert torch.equal(any_policy.act(seen, seeded()), before)

    def test_gradient_reaches_every_weight_and_every_missing_embedding(self, any_policy, observe):
        seen = observe()
        seen.sensor_valid[0] = seen.state_valid[1] = 0
        seen.slot_valid[2] = False
        any_policy.loss(seen, seen.action, seen.action_valid, seeded())[0].backward()
        for name, parameter in any_policy.named_parameters():
            assert parameter.grad is not None, name
            assert parameter.grad.abs().max() > 0, name

    def test_parameters_are_told_by_part(self, any_policy):
        parameters = any_policy.parameter_table()
        parts = ["features", "sensor", "state", "fusion", "expert"]
        assert [name for name, _ in parameters] == parts
        total = sum(p.numel() for p in any_policy.parameters())
        assert describe_size(any_policy).startswith(f"parameters: {total:,} (features ")


class TestGuide:
    """A chunk to continue, in physical units."""

    @pytest.fixture(params=["diffusion", "flow_matching"])
    def policy(self, request, build_policy):
        return build_policy(model_type=request.param).eval()

    @staticmethod
    def continuing(policy: Policy) -> Guide:
        chunk = policy.action_normalizer.invert(torch.full((4, 8, 7), 0.5))
        return Guide(chunk, torch.ones(4, 8))

    def test_the_expert_is_given_it_normalised_for_every_sample(self, policy, observe, monkeypatch):
        given = []
        act = policy.expert.act
        monkeypatch.setattr(policy.expert, "act", lambda *of: (given.append(of[2]), act(*of))[1])
        guide = self.continuing(policy)
        guide.weight[2] = 0.25
        chunks = policy.sample(observe(), 3, seeded(), guide)
        torch.testing.assert_close(given[0].chunk, torch.full((12, 8, 7), 0.5))
        assert torch.equal(given[0].weight, guide.weight.repeat(3, 1))
        assert chunks.shape == (3, 4, 8, 7)
        assert not chunks.requires_grad

    def test_it_works_where_nothing_is_to_be_differentiated(self, policy, observe):
        seen, guide = observe(), self.continuing(policy)
        expected = policy.act(seen, seeded(), guide)
        with torch.inference_mode():
            made = replace(seen, features=seen.features + 0)
            same = Guide(guide.chunk + 0, guide.weight + 0)
            assert torch.equal(policy.act(made, seeded(), same), expected)


def test_loss_normalises_the_target_and_act_inverts(build_policy, observe, normalization):
    policy, seen = build_policy(), observe()
    torch.nn.init.zeros_(policy.expert.head.weight)
    mean = torch.tensor(normalization.action.mean, dtype=torch.float32).expand(4, 8, 7)
    torch.testing.assert_close(policy.act(seen), mean)
    loss, parts = policy.loss(seen, mean, seen.action_valid)
    assert loss == 0
    assert set(parts) == {"translation", "rotation", "gripper"}


def test_stored_dtypes_are_cast_inside(build_policy, observe):
    policy, seen = build_policy(), observe()
    exact = policy.act(seen)
    seen.features, seen.sensor = seen.features.bfloat16(), seen.sensor.half()
    torch.testing.assert_close(policy.act(seen), exact, atol=0.02, rtol=0.02)


@pytest.mark.parametrize("kept", ["features", "sensor", "robot_state"])
def test_disabled_streams_have_no_encoder_and_no_influence(kept, build_policy, observe):
    switches = {f"{n}_enabled": n == kept for n in ("features", "sensor", "robot_state")}
    policy, seen = build_policy(**switches), observe()
    own = kept.removeprefix("robot_")
    assert [name for name, _ in policy.parameter_table()] == [own, "fusion", "expert"]
    before = policy.act(seen)
    for name in {"features", "sensor", "state"} - {own}:
        setattr(seen, name, getattr(seen, name) + 5)
    assert torch.equal(policy.act(seen), before)


def test_streams_that_the_store_lacks_have_no_encoder(shape, normalization, small_params, observe):
    lacking = replace(shape, sensor_channels=0, state_dim=0)
    policy = Policy(small_params(), lacking, replace(normalization, sensor=None, state=None))
    seen = observe()
    seen.sensor, seen.sensor_valid = torch.zeros(4, 13, 0), torch.zeros(4, dtype=torch.int64)
    seen.state, seen.state_valid = torch.zeros(4, 25, 0), torch.zeros(4, dtype=torch.int64)
    assert list(policy.encoders) == ["features"]
    assert policy.act(seen).shape == (4, 8, 7)


def test_nothing_to_look_at_is_refused(build_policy):
    with pytest.raises(ConfigError, match="5 feature slots, 9 sensor channels"):
        build_policy(features_enabled=False, sensor_enabled=False, robot_state_enabled=False)


def test_all_but_positions_say_how_far_to_move():
    action = {"names": ["dx", "gripper", "rx"], "units": ["mm", "", "deg"]}
    for kind, moves in (("delta", True), ("velocity", True), ("absolute", False)):
        assert moving_channels(action | {"kind": kind}) == (moves, False, moves)


def test_wrong_shapes_are_caught_by_the_annotations(build_policy, observe):
    policy, seen = build_policy(), observe()
    with pytest.raises(Exception, match=r"(?i)type-?check"):
        policy.loss(seen, seen.action[0], seen.action_valid)


RATES = {"features": 0.5, "sensor": 0.3, "state": 0.0}


class TestModalityDropout:
    @staticmethod
    def everything(batch: int) -> dict[str, torch.Tensor]:
        return {
            "features": torch.ones(batch, 5, dtype=torch.bool),
            "sensor": torch.full((batch,), 13),
            "state": torch.full((batch,), 25),
        }

    def test_streams_go_missing_at_their_rates_and_whole(self):
        before = self.everything(4000)
        after = drop_streams(before, RATES, seeded())
        gone = {name: (valid == 0).reshape(4000, -1) for name, valid in after.items()}
        for name, rate in RATES.items():
            assert torch.equal(gone[name].any(1), gone[name].all(1))
            assert gone[name].all(1).float().mean().item() == pytest.approx(rate, abs=0.03)
            kept = ~gone[name].all(1)
            assert torch.equal(after[name][kept], before[name][kept])
            assert after[name].dtype == before[name].dtype

    def test_a_sample_never_loses_all_that_it_has(self):
        before = self.everything(3000)
        before["features"][:1000], before["state"][:2000] = False, 0
        before["sensor"][0], before["state"][1] = 0, 0
        rates = {"features": 1.0, "sensor": 1.0, "state": 0.9}
        after = drop_streams(before, rates, seeded())
        left = torch.stack([(v.reshape(3000, -1) > 0).any(1) for v in after.values()], 1)
        had = torch.stack([(v.reshape(3000, -1) > 0).any(1) for v in before.values()], 1)
        assert torch.equal(left.any(1), had.any(1))
        assert not left[0].any()
        assert not (left & ~had).any()
        # Of two that would both go, each is kept as often.
        assert left[1000:2000, 0].float().mean().item() == pytest.approx(0.5, abs=0.06)

    def test_two_streams_share_what_one_of_them_must_keep(self):
        """At rates p and q both would go from pq of the samples; each stays in half of these."""
        before = self.everything(8000)
        del before["state"]
        after = drop_streams(before, {"features": 0.8, "sensor": 0.6}, seeded())
        missing = [(v.reshape(8000, -1) == 0).all(1).float().mean().item() for v in after.values()]
        assert missing == pytest.approx([0.8 - 0.24, 0.6 - 0.24], abs=0.02)

    def test_a_dropped_stream_is_one_that_is_missing(self, build_policy, observe):
        policy, seen = build_policy(drop_features=1.0, drop_sensor=1.0).train(), observe()
        trained, _ = policy.loss(seen, seen.action, seen.action_valid)
        whole, _ = policy.eval().loss(seen, seen.action, seen.action_valid)
        seen.slot_valid[:] = False
        seen.sensor_valid[:] = 0
        absent, _ = policy.loss(seen, seen.action, seen.action_valid)
        assert torch.equal(trained, absent)
        assert not torch.equal(trained, whole)

    def test_only_training_drops(self, build_policy, observe):
        dropping, plain = build_policy(drop_state=0.9).train(), build_policy().train()
        seen = observe()
        assert torch.equal(dropping.act(seen), plain.act(seen))
        losses = [p.eval().loss(seen, seen.action, seen.action_valid)[0] for p in (dropping, plain)]
        assert torch.equal(*losses)

    def test_rates_of_zero_draw_nothing(self, build_policy, observe):
        policy, seen, generator = build_policy().train(), observe(), seeded()
        policy.loss(seen, seen.action, seen.action_valid, generator)
        assert torch.equal(generator.get_state(), seeded().get_state())
