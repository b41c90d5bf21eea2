"""Solvers, times and flows against closed forms; nothing is trained here."""

import math
from itertools import pairwise
from typing import Any

import pytest
import torch
from scipy.integrate import quad
from scipy.stats import beta as beta_distribution
from scipy.stats import kstest
from torch import Tensor, nn

from pipeline.base.config import FlowMatchingParams
from pipeline.policy.flow_matching import BetaTimes, FlowMatchingActionExpert, integrate


class Optimal(nn.Module):
    """The velocity of the straight-path flow to a mixture; counts how often it is asked."""

    def __init__(self, mixture: Any) -> None:
        super().__init__()
        self.mixture, self.asked = mixture, 0

    def prepare(self, context: Tensor) -> Tensor:
        return context

    def forward(self, noisy: Tensor, time: Tensor, context: Tensor, valid: Any = None) -> Tensor:
        self.asked += 1
        sample, noise = self.mixture.expectations(noisy.double(), time, 1 - time)
        return (sample - noise).float()


@pytest.fixture
def optimal():
    """`optimal(mixture, **arguments)`: an expert of one-step chunks whose network is the best."""

    def make(mixture: Any, **arguments: Any) -> FlowMatchingActionExpert:
        width = mixture.means.shape[1]
        expert = FlowMatchingActionExpert(
            horizon=1, action_dim=width, dim=8, layers=1, heads=1, **arguments
        )
        expert.denoiser = Optimal(mixture)  # type: ignore[assignment]
        return expert

    return make


def drawn(expert: FlowMatchingActionExpert, count: int = 4000) -> Tensor:
    return expert.act(torch.zeros(count, 1, 8), torch.Generator().manual_seed(0))


class TestSolvers:
    @pytest.mark.parametrize(("solver", "order"), [("euler", 1), ("rk4", 4)])
    def test_each_has_its_order(self, solver, order):
        """dx/dt = -2 (t + 1) x^2 from x(0) ends at 1 / (1 / x(0) + 3)."""
        start = torch.tensor([0.5, 1.0], dtype=torch.float64)
        errors = []
        for steps in (20, 40, 80):
            end = integrate(lambda x, t: -2 * (t + 1) * x**2, start, steps, solver)  # type: ignore
            errors.append(float((end - 1 / (1 / start + 3)).abs().max()))
        for coarse, fine in pairwise(errors):
            assert math.log2(coarse / fine) == pytest.approx(order, abs=0.15)

    @pytest.mark.parametrize(("solver", "stages"), [("euler", 1), ("rk4", 4)])
    def test_the_network_is_asked_once_a_stage(self, solver, stages, two_modes, optimal):
        expert = optimal(two_modes, solver=solver, sampling_steps=6)
        drawn(expert, 5)
        assert expert.denoiser.asked == 6 * stages


class TestFlow:
    def test_to_a_gaussian_it_scales_and_shifts_the_noise(self, mixture, optimal):
        """x_t = t m + sqrt((1 - t)^2 + t^2 s^2) x_0: the noise goes to m + s noise."""
        gaussian = mixture(torch.tensor([[1.2, -0.4]]), torch.ones(1), 0.3)
        noise = torch.randn(500, 1, 2, generator=torch.Generator().manual_seed(0))
        chunk = drawn(optimal(gaussian, solver="rk4", sampling_steps=40), 500)
        expected = gaussian.means + gaussian.spread * noise
        torch.testing.assert_close(chunk, expected, rtol=0, atol=2e-3)

    @pytest.mark.parametrize(("solver", "steps"), [("euler", 100), ("rk4", 12)])
    def test_every_solver_draws_two_modes(self, solver, steps, two_modes, optimal):
        expert = optimal(two_modes, solver=solver, sampling_steps=steps)
        weights, means, spreads, near = two_modes.judge(drawn(expert))
        torch.testing.assert_close(weights, two_modes.weights, rtol=0, atol=0.025)
        torch.testing.assert_close(means, two_modes.means, rtol=0, atol=0.02)
        assert ((spreads - two_modes.spread).abs() < 0.15 * two_modes.spread).all()
        assert near > 0.98


class TestTimes:
    def test_the_share_of_noise_is_beta_distributed(self):
        drawn = torch.rand(20_000, generator=torch.Generator().manual_seed(0))
        times = BetaTimes()(drawn)
        assert times.min() >= 0
        assert times.max() <= 1
        expected = beta_distribution(1.5, 1.0).cdf
        assert kstest((1 - times).numpy(), expected).statistic < 0.012

    def test_the_best_network_has_the_smallest_loss_there_is(self, mixture, optimal):
        """The variance of chunk - noise given x_t, over the times that are drawn."""
        gaussian = mixture(torch.tensor([[0.5, -1.0]]), torch.ones(1), 0.6)
        generator, count = torch.Generator().manual_seed(0), 100_000
        chunk, valid = gaussian.draw(count, generator), torch.ones(count, 1, dtype=torch.bool)
        expert = optimal(gaussian)
        loss, _ = expert.drawn_loss(torch.zeros(count, 1, 8), chunk, valid, generator)
        share = beta_distribution(1.5, 1.0)

        def weighed(t: float) -> float:
            return share.pdf(1 - t) * 0.36 / ((1 - t) ** 2 + 0.36 * t**2)

        assert float(loss) == pytest.approx(quad(weighed, 0, 1)[0], rel=0.01)


def test_the_section_of_params_is_the_constructor():
    params = FlowMatchingParams().model_dump()
    expert = FlowMatchingActionExpert(dim=8, layers=1, heads=1, **params)
    assert (expert.sampling_steps, expert.solver) == (params["sampling_steps"], "euler")
    assert expert.draws == params["draws"]
