"""What every action expert guarantees, and the loss that they share."""

import inspect
from collections.abc import Callable

import pytest
import torch
from torch.nn import functional as F

from pipeline.errors import ConfigError
from pipeline.models import ActionExpert, RegressionActionExpert
from pipeline.models.expert import GroupedLoss

GROUPS = ("translation", "translation", "rotation", "gripper")


def regression(refinements: int) -> RegressionActionExpert:
    return RegressionActionExpert(
        horizon=5, action_dim=4, dim=16, layers=1, heads=2, dropout=0.0, refinements=refinements,
        groups=GROUPS,
    )  # fmt: skip


EXPERTS: dict[str, Callable[[], ActionExpert]] = {
    "regression": lambda: regression(1),
    "refined regression": lambda: regression(3),
}


@pytest.fixture(params=EXPERTS)
def expert(request: pytest.FixtureRequest) -> ActionExpert:
    return EXPERTS[request.param]()


@pytest.fixture
def context() -> torch.Tensor:
    return torch.randn(3, 2, 16)


class TestActionExpertContract:
    def test_shapes(self, expert: ActionExpert, context: torch.Tensor) -> None:
        assert expert.act(context).shape == (3, 5, 4)
        valid = torch.ones(3, 5, dtype=torch.bool)
        loss, parts = expert.loss(context, torch.randn(3, 5, 4), valid)
        assert loss.shape == ()
        assert set(parts) == set(GROUPS)
        assert not any(part.requires_grad for part in parts.values())

    def test_masked_steps_count_nothing(self, expert: ActionExpert, context: torch.Tensor) -> None:
        target, valid = torch.randn(3, 5, 4), torch.ones(3, 5, dtype=torch.bool)
        valid[0, 3:] = False
        changed = target.masked_fill(~valid.unsqueeze(-1), float("nan"))
        generators = [torch.Generator().manual_seed(3) for _ in range(2)]
        loss, _ = expert.loss(context, target, valid, generators[0])
        again, _ = expert.loss(context, changed, valid, generators[1])
        assert torch.equal(loss, again)
        again.backward()
        assert all(torch.isfinite(p.grad).all() for p in expert.parameters())

    def test_act_repeats_with_its_generator(
        self, expert: ActionExpert, context: torch.Tensor
    ) -> None:
        first, second = (expert.act(context, torch.Generator().manual_seed(5)) for _ in range(2))
        assert torch.equal(first, second)

    def test_no_valid_step_gives_a_finite_loss(
        self, expert: ActionExpert, context: torch.Tensor
    ) -> None:
        loss, _ = expert.loss(context, torch.randn(3, 5, 4), torch.zeros(3, 5, dtype=torch.bool))
        loss.backward()
        assert loss == 0

    def test_context_and_all_weights_get_gradient(
        self, expert: ActionExpert, context: torch.Tensor
    ) -> None:
        context.requires_grad_()
        valid = torch.ones(3, 5, dtype=torch.bool)
        expert.loss(context, 3 * torch.randn(3, 5, 4), valid)[0].backward()
        assert context.grad is not None
        assert context.grad.abs().max() > 0
        for name, parameter in expert.named_parameters():
            assert parameter.grad is not None, name
            assert parameter.grad.abs().max() > 0, name


class TestTheAnswerIsNoInput:
    """The seeds' regression was given the target chunk and added to it."""

    def test_predict_takes_the_context_and_nothing_else(self) -> None:
        parameters = list(inspect.signature(RegressionActionExpert.predict).parameters)
        assert parameters == ["self", "context"]

    @pytest.mark.parametrize("refinements", [1, 3])
    def test_the_loss_is_that_of_what_act_says_whatever_the_target(
        self, refinements: int, context: torch.Tensor
    ) -> None:
        expert = regression(refinements)
        said = expert.act(context)
        valid = torch.ones(3, 5, dtype=torch.bool)
        for target in (torch.randn(3, 5, 4), 100 * torch.randn(3, 5, 4), said.detach()):
            expected, _ = expert.grouped(said, target, valid)
            assert torch.equal(expert.loss(context, target, valid)[0], expected)

    @pytest.mark.parametrize("refinements", [1, 3])
    def test_the_gradient_to_the_target_comes_from_the_error_alone(
        self, refinements: int, context: torch.Tensor
    ) -> None:
        expert = regression(refinements)
        target = torch.randn(3, 5, 4, requires_grad=True)
        valid = torch.ones(3, 5, dtype=torch.bool)
        loss, _ = expert.loss(context, target, valid)
        through_loss = torch.autograd.grad(loss, target)[0]
        apart = expert.grouped(expert.act(context).detach(), target, valid)[0]
        assert torch.equal(through_loss, torch.autograd.grad(apart, target)[0])

    def test_independent_targets_cannot_be_fitted(self) -> None:
        """With the answer as an input, the loss on targets unrelated to the context would be 0."""
        expert = regression(2)
        optimizer = torch.optim.AdamW(expert.parameters(), lr=3e-3)
        valid = torch.ones(64, 5, dtype=torch.bool)
        for _ in range(60):
            context = torch.zeros(64, 2, 16)
            loss, _ = expert.loss(context, torch.randn(64, 5, 4), valid)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        unexplained = F.smooth_l1_loss(torch.zeros(10_000), torch.randn(10_000))
        assert loss > 0.8 * unexplained


class TestGroupedLoss:
    def test_each_group_is_the_mean_of_its_valid_entries(self) -> None:
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
    def test_a_loss_without_weight_is_refused(self, weights: dict[str, float]) -> None:
        with pytest.raises(ConfigError, match="group_weights"):
            GroupedLoss(("other", "other"), weights)


def test_default_expert_is_the_seeds() -> None:
    with torch.device("meta"):
        expert = RegressionActionExpert()
    assert (expert.horizon, expert.action_dim) == (8, 7)
    assert sum(p.numel() for p in expert.parameters()) == 16_824_839
