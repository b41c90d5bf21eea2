"""Solvers, times and flows against closed forms; nothing is trained here."""

import math
from itertools import pairwise

import pytest
import torch
from scipy.integrate import quad
from scipy.stats import beta as beta_distribution
from scipy.stats import kstest

from pipeline.base.config import FlowMatchingParams
from pipeline.policy.flow_matching import BetaTimes, FlowMatchingActionExpert, integrate
from tests.policy.optimal import TWO_MODES, Mixture, drawn, optimal


@pytest.mark.parametrize(("solver", "order"), [("euler", 1), ("rk4", 4)])
def test_each_solver_has_its_order(solver, order):
    """dx/dt = -2 (t + 1) x^2 from x(0) ends at 1 / (1 / x(0) + 3)."""
    start = torch.tensor([0.5, 1.0], dtype=torch.float64)
    errors = []
    for steps in (20, 40, 80):
        end = integrate(lambda x, t: -2 * (t + 1) * x**2, start, steps, solver)  # type: ignore
        errors.append(float((end - 1 / (1 / start + 3)).abs().max()))
    for coarse, fine in pairwise(errors):
        assert math.log2(coarse / fine) == pytest.approx(order, abs=0.15)


@pytest.mark.parametrize(("solver", "stages"), [("euler", 1), ("rk4", 4)])
def test_the_network_is_asked_once_a_stage(solver, stages):
    expert = optimal(FlowMatchingActionExpert, TWO_MODES, solver=solver, sampling_steps=6)
    drawn(expert, 5)
    assert expert.denoiser.asked == 6 * stages


def test_the_flow_to_a_gaussian_scales_and_shifts_the_noise():
    """x_t = t m + sqrt((1 - t)^2 + t^2 s^2) x_0: the noise goes to m + s noise."""
    gaussian = Mixture(torch.tensor([[1.2, -0.4]]), torch.ones(1), 0.3)
    noise = torch.randn(500, 1, 2, generator=torch.Generator().manual_seed(0))
    expert = optimal(FlowMatchingActionExpert, gaussian, solver="rk4", sampling_steps=40)
    expected = gaussian.means + gaussian.spread * noise
    torch.testing.assert_close(drawn(expert, 500), expected, rtol=0, atol=2e-3)


def test_the_share_of_noise_is_beta_distributed():
    times = BetaTimes()(torch.rand(20_000, generator=torch.Generator().manual_seed(0)))
    assert times.min() >= 0
    assert times.max() <= 1
    expected = beta_distribution(1.5, 1.0).cdf
    assert kstest((1 - times).numpy(), expected).statistic < 0.012


def test_the_best_network_has_the_smallest_loss_there_is():
    """The variance of chunk - noise given x_t, over the times that are drawn."""
    gaussian = Mixture(torch.tensor([[0.5, -1.0]]), torch.ones(1), 0.6)
    generator, count = torch.Generator().manual_seed(0), 100_000
    chunk, valid = gaussian.draw(count, generator), torch.ones(count, 1, dtype=torch.bool)
    expert = optimal(FlowMatchingActionExpert, gaussian)
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
