"""What every action expert guarantees, and the loss that they share."""

import inspect
from typing import Any

import pytest
import torch
from torch.nn import functional as F

from pipeline.base.errors import ConfigError
from pipeline.policy.denoiser import DrawingExpert
from pipeline.policy.diffusion import DiffusionActionExpert
from pipeline.policy.expert import ActionExpert, GroupedLoss, Guide
from pipeline.policy.flow_matching import FlowMatchingActionExpert
from pipeline.policy.regression import RegressionActionExpert

GROUPS = ("translation", "translation", "rotation", "gripper")
SMALL: dict[str, Any] = {
    "horizon": 5, "action_dim": 4, "dim": 16, "layers": 2, "heads": 2, "dropout": 0.0,
    "groups": GROUPS,
}  # fmt: skip


def seeded(seed: int = 3) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def everything() -> torch.Tensor:
    return torch.ones(3, 5, dtype=torch.bool)


def full_guide() -> Guide:
    return Guide(torch.full((3, 5, 4), 0.5), torch.ones(3, 5))


@pytest.fixture
def context():
    return torch.randn(3, 2, 16)


class ActionExpertContract:
    """Inherit it, name the class, and give each `variant` of its own arguments that must hold."""

    kind: type[ActionExpert]

    def build(self, **arguments: Any) -> ActionExpert:
        torch.manual_seed(2)
        return self.kind(**SMALL | arguments)

    @pytest.fixture
    def expert(self, variant):
        return self.build(**variant)

    def test_shapes(self, expert, context):
        assert (expert.horizon, expert.action_dim) == (5, 4)
        chunk = expert.act(context)
        assert chunk.shape == (3, 5, 4)
        assert chunk.dtype == torch.float32
        loss, parts = expert.loss(context, torch.randn(3, 5, 4), everything())
        assert loss.shape == ()
        assert set(parts) == set(GROUPS)
        assert not any(part.requires_grad for part in parts.values())

    def test_masked_steps_count_nothing(self, expert, context):
        target, valid = torch.randn(3, 5, 4), everything()
        valid[0, 3:] = False
        loss, parts = expert.loss(context, target, valid, seeded())
        for garbage in (1e9, float("nan")):
            changed = target.masked_fill(~valid.unsqueeze(-1), garbage)
            again, same = expert.loss(context, changed, valid, seeded())
            assert torch.equal(loss, again)
            assert all(torch.equal(parts[name], same[name]) for name in parts)
        again.backward()
        assert all(torch.isfinite(p.grad).all() for p in expert.parameters())  # type: ignore
        loss, _ = expert.loss(context, target, ~everything())
        loss.backward()
        assert loss == 0
        assert all(torch.isfinite(p.grad).all() for p in expert.parameters())  # type: ignore

    def test_context_and_all_weights_get_gradient(self, expert, context):
        context.requires_grad_()
        expert.loss(context, 3 * torch.randn(3, 5, 4), everything())[0].backward()
        assert context.grad is not None
        assert (context.grad.abs().amax(dim=2) > 0).all()
        for name, parameter in expert.named_parameters():
            assert parameter.grad is not None, name
            assert parameter.grad.abs().max() > 0, name

    def test_the_generator_decides_everything_random(self, expert, context):
        target = torch.randn(3, 5, 4)
        first, again, other = (expert.act(context, seeded(seed)) for seed in (5, 5, 6))
        assert torch.equal(first, again)
        assert torch.equal(first, other) != expert.stochastic
        losses = [expert.loss(context, target, everything(), seeded(s))[0] for s in (5, 5, 6)]
        assert torch.equal(losses[0], losses[1])
        assert torch.equal(losses[0], losses[2]) != expert.stochastic

    def test_noise_that_is_given_is_noise_that_is_drawn(self, expert, context):
        source = seeded()
        given = (torch.randn(3, 5, 4, generator=source) for _ in range(1000))
        assert torch.equal(expert.act(context, given), expert.act(context, seeded()))

    def test_a_given_generator_leaves_the_global_one_alone(self, expert, context):
        before = torch.get_rng_state()
        expert.act(context, seeded())
        expert.loss(context, torch.randn(3, 5, 4, generator=seeded()), everything(), seeded())
        assert torch.equal(torch.get_rng_state(), before)

    def test_a_chunk_follows_from_its_own_row(self, expert, context):
        changed = torch.cat([context[:2], torch.randn(1, 2, 16)])
        chunk, other = expert.act(context, seeded()), expert.act(changed, seeded())
        torch.testing.assert_close(chunk[:2], other[:2])
        assert not torch.allclose(chunk[2], other[2])

    def test_act_never_sees_the_target(self, expert, context):
        assert list(inspect.signature(expert.act).parameters) == ["context", "generator", "guide"]
        before = expert.act(context, seeded())
        expert.loss(context, 100 * torch.randn(3, 5, 4), everything(), seeded())
        assert torch.equal(expert.act(context, seeded()), before)

    def test_the_weights_are_all_that_act_needs(self, variant, expert, context):
        torch.manual_seed(99)
        restored = self.kind(**SMALL | variant)
        restored.load_state_dict(expert.state_dict())
        assert torch.equal(restored.act(context, seeded()), expert.act(context, seeded()))

    def test_autocast_changes_it_by_its_noise(self, expert, context):
        target = torch.randn(3, 5, 4)
        exact, _ = expert.loss(context, target, everything(), seeded())
        with torch.autocast("cpu", torch.bfloat16):
            loss, _ = expert.loss(context, target, everything(), seeded())
            chunk = expert.act(context.bfloat16(), seeded())
        loss.backward()
        assert (loss.dtype, chunk.dtype) == (torch.float32, torch.float32)
        torch.testing.assert_close(loss, exact, rtol=0.02, atol=0)
        assert torch.isfinite(chunk).all()
        assert all(torch.isfinite(p.grad).all() for p in expert.parameters())  # type: ignore

    def test_a_group_without_weight_moves_nothing(self, variant, context):
        expert = self.build(**variant, group_weights={"translation": 0.0, "rotation": 0.0})
        target = torch.randn(3, 5, 4)
        loss = expert.drawn_loss if isinstance(expert, DrawingExpert) else expert.loss
        total, parts = loss(context, target, everything(), seeded())
        torch.testing.assert_close(total.detach(), parts["gripper"])


class TestRegression(ActionExpertContract):
    kind = RegressionActionExpert

    @pytest.fixture(params=[{}], ids=str)
    def variant(self, request):
        return request.param


class SamplingExpertContract(ActionExpertContract):
    """What an expert with a `Denoiser` guarantees besides."""

    def test_masked_steps_are_not_attended_to(self, expert, context):
        """What the chunk's end looks like would tell the others that the episode ends."""
        valid = everything()
        valid[:, 3:] = False
        expert.loss(context, torch.randn(3, 5, 4), valid)[0].backward()
        gradient = expert.denoiser.positions.grad
        assert gradient is not None
        assert (gradient[:3].abs().amax(dim=1) > 0).all()
        assert (gradient[3:] == 0).all()

    def test_act_keeps_no_graph(self, expert, context):
        assert not expert.act(context.requires_grad_()).requires_grad
        assert not expert.act(context, guide=full_guide()).requires_grad
        assert all(p.grad is None for p in expert.parameters())

    def test_a_guide_pulls_its_own_rows(self, expert, context):
        """Rows without weight differ by how attention is computed where it is differentiated."""
        guide = full_guide()
        guide.weight[1:] = 0
        free, guided = expert.act(context, seeded()), expert.act(context, seeded(), guide)
        torch.testing.assert_close(guided[1:], free[1:], rtol=0, atol=1e-6)
        before, after = ((x[0] - guide.chunk[0]).square().mean() for x in (free, guided))
        assert after < before

    def test_a_guide_leaves_what_is_drawn(self, expert, context):
        generator, apart = seeded(), seeded()
        expert.act(context, generator, full_guide())
        expert.act(context, apart)
        assert torch.equal(generator.get_state(), apart.get_state())


class TestDiffusion(SamplingExpertContract):
    kind = DiffusionActionExpert

    @pytest.fixture(
        params=[
            {"prediction": "sample", "clip": None, "sampling_steps": 3},
            {"prediction": "v", "eta": 0.5},
            {"sampler": "ddpm", "timesteps": 12},
        ],
        ids=str,
    )
    def variant(self, request):
        return request.param


class TestFlowMatching(SamplingExpertContract):
    kind = FlowMatchingActionExpert

    @pytest.fixture(params=[{}, {"solver": "rk4"}], ids=str)
    def variant(self, request):
        return request.param


class TestGroupedLoss:
    def test_each_group_is_the_mean_of_its_valid_entries(self):
        target, valid = 2 * torch.randn(3, 5, 4), torch.rand(3, 5) > 0.3
        prediction = torch.randn(3, 5, 4)
        loss, parts = GroupedLoss(GROUPS, {"rotation": 3.0})(prediction, target, valid)
        translation = F.smooth_l1_loss(prediction[valid][:, :2], target[valid][:, :2])
        rotation = F.smooth_l1_loss(prediction[valid][:, 2], target[valid][:, 2])
        gripper = F.smooth_l1_loss(prediction[valid][:, 3], target[valid][:, 3])
        torch.testing.assert_close(parts["translation"], translation)
        torch.testing.assert_close(parts["rotation"], rotation)
        torch.testing.assert_close(parts["gripper"], gripper)
        torch.testing.assert_close(loss, (translation + 3 * rotation + gripper) / 5)

    @pytest.mark.parametrize("weights", [{"other": 0.0}, {"other": -1.0}])
    def test_a_loss_without_weight_is_refused(self, weights):
        with pytest.raises(ConfigError, match="group_weights"):
            GroupedLoss(("other", "other"), weights)


@pytest.mark.parametrize(
    ("kind", "parameters"),
    [
        (RegressionActionExpert, 16_824_839),
        (DiffusionActionExpert, 19_299_903),
        (FlowMatchingActionExpert, 19_299_903),
    ],
)
def test_default_experts_keep_their_size(kind, parameters):
    with torch.device("meta"):
        expert = kind()
    assert (expert.horizon, expert.action_dim) == (8, 7)
    assert sum(p.numel() for p in expert.parameters()) == parameters


@pytest.mark.parametrize("kind", [DiffusionActionExpert, FlowMatchingActionExpert])
def test_several_draws_are_a_batch_that_repeats(kind):
    expert = kind(horizon=4, action_dim=3, dim=16, layers=1, heads=2, dropout=0.0, draws=3)
    context, actions = torch.randn(2, 5, 16), torch.randn(2, 4, 3)
    valid = torch.tensor([[True] * 4, [True, True, False, False]])
    loss, _ = expert.loss(context, actions, valid, seeded(1))
    expert.draws = 1
    guess = expert.direct(context.mean(dim=1)).unflatten(-1, (4, 3))
    drawn_alone = expert.drawn_loss(
        context, actions.masked_fill(~valid[..., None], 0.0), valid, seeded(1)
    )[0]
    whole = expert.loss(context, actions, valid, seeded(1))[0]
    half = expert.grouped(guess, actions, valid)[0] / 2
    torch.testing.assert_close(whole, drawn_alone + half)
    alike = [x.repeat(3, *[1] * (x.ndim - 1)) for x in (context, actions, valid)]
    torch.testing.assert_close(expert.loss(*alike, seeded(1))[0], loss)
    assert not loss.isclose(whole)
