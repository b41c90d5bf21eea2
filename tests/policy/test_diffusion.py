"""Sampling with the best possible network, against closed forms; nothing is trained here."""

from itertools import pairwise
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from pipeline.base.config import DiffusionParams
from pipeline.policy.diffusion import DiffusionActionExpert, NoiseSchedule


class Optimal(nn.Module):
    """What the best network says where the chunks are drawn from a mixture."""

    def __init__(self, mixture: Any, schedule: NoiseSchedule, kind: Any) -> None:
        super().__init__()
        self.mixture, self.schedule, self.kind = mixture, schedule, kind

    def prepare(self, context: Tensor) -> Tensor:
        return context

    def forward(self, noisy: Tensor, time: Tensor, context: Tensor, valid: Any = None) -> Tensor:
        step = (time * self.schedule.timesteps).round().long()
        signal, noise = self.schedule.signal[step], self.schedule.noise[step]
        sample, epsilon = self.mixture.expectations(noisy.double(), signal, noise)
        return self.schedule.target(self.kind, sample, epsilon, step).float()


@pytest.fixture
def optimal():
    """`optimal(mixture, **arguments)`: an expert of one-step chunks whose network is the best."""

    def make(mixture: Any, **arguments: Any) -> DiffusionActionExpert:
        width = mixture.means.shape[1]
        expert = DiffusionActionExpert(
            horizon=1, action_dim=width, dim=8, layers=1, heads=1, **arguments
        )
        expert.denoiser = Optimal(mixture, expert.schedule, expert.prediction)  # type: ignore
        return expert

    return make


def drawn(expert: DiffusionActionExpert, count: int = 4000, seed: int = 0) -> Tensor:
    return expert.act(torch.zeros(count, 1, 8), torch.Generator().manual_seed(seed))


class TestTwoModes:
    @pytest.mark.parametrize(
        "arguments",
        [
            {"sampler": "ddpm", "prediction": "epsilon"},
            {"sampling_steps": 100, "eta": 0.0, "prediction": "v"},
            {"sampling_steps": 100, "eta": 0.5, "prediction": "epsilon"},
        ],
        ids=str,
    )
    def test_every_sampler_draws_them(self, arguments, two_modes, optimal):
        expert = optimal(two_modes, timesteps=200, **arguments)
        weights, means, spreads, near = two_modes.judge(drawn(expert))
        torch.testing.assert_close(weights, two_modes.weights, rtol=0, atol=0.025)
        torch.testing.assert_close(means, two_modes.means, rtol=0, atol=0.02)
        assert ((spreads - two_modes.spread).abs() < 0.15 * two_modes.spread).all()
        assert near > 0.99


@pytest.mark.parametrize(("eta", "count"), [(0.0, 10), (0.6, 10)])
def test_samples_of_a_gaussian_have_the_mean_and_spread_that_theory_gives(
    eta, count, mixture, optimal
):
    """The best network is linear there, so each step maps mean and variance in closed form."""
    gaussian = mixture(torch.tensor([[1.2]]), torch.ones(1), 0.4)
    expert = optimal(gaussian, sampling_steps=count, eta=eta, clip=None)
    alpha_bar = expert.schedule.alpha_bar.double().tolist()
    mean, variance = 0.0, 1.0
    for now, to in pairwise(expert.steps):
        a, b = alpha_bar[now], alpha_bar[to]
        random = eta**2 * (1 - b) / (1 - a) * (1 - a / b)
        left = max(1 - b - random, 0.0)
        kept = a**0.5 * 0.16 / (a * 0.16 + 1 - a)  # of x - mean, in the predicted sample
        slope = b**0.5 * kept + left**0.5 * (1 - a**0.5 * kept) / (1 - a) ** 0.5
        mean = b**0.5 * 1.2 + slope * (mean - a**0.5 * 1.2)
        variance = slope**2 * variance + random
    samples = drawn(expert, 20_000)
    assert float(samples.mean()) == pytest.approx(mean, abs=0.012)
    assert float(samples.std()) == pytest.approx(variance**0.5, rel=0.025)


class TestFlow:
    def test_eta_zero_draws_its_first_noise_and_no_more(self, two_modes, optimal):
        generator, apart = torch.Generator().manual_seed(0), torch.Generator().manual_seed(0)
        optimal(two_modes).act(torch.zeros(7, 1, 8), generator)
        torch.randn(7, 1, 2, generator=apart)
        assert torch.equal(generator.get_state(), apart.get_state())


class TestClip:
    """The seeds clamped x0 and then took the step from the unclamped one."""

    @pytest.mark.parametrize(("prediction", "sampler"), [("epsilon", "ddpm"), ("v", "ddim")])
    def test_a_network_gone_wild_stays_within(self, prediction, sampler, two_modes, optimal):
        expert = optimal(two_modes, prediction=prediction, sampler=sampler, clip=1.5)
        expert.denoiser = Wild()  # type: ignore[assignment]
        chunk = drawn(expert, 50)
        torch.testing.assert_close(chunk.abs(), torch.full_like(chunk, 1.5), rtol=1e-3, atol=0)

    def test_none_does_not_clip(self, mixture, optimal):
        far = mixture(torch.tensor([[9.0, -9.0]]), torch.ones(1), 0.1)
        assert drawn(optimal(far, sampling_steps=100), 500).abs().mean() < 6
        free = drawn(optimal(far, sampling_steps=100, clip=None), 500)
        torch.testing.assert_close(free.mean(0, keepdim=True), far.means[None], rtol=0, atol=0.05)


class Wild(nn.Module):
    def prepare(self, context: Tensor) -> Tensor:
        return context

    def forward(self, noisy: Tensor, time: Tensor, context: Tensor, valid: Any = None) -> Tensor:
        return torch.full_like(noisy, 1e6)


@pytest.mark.parametrize("prediction", ["epsilon", "sample", "v"])
def test_the_best_network_has_the_smallest_loss_there_is(prediction, mixture, optimal):
    """The variance of the target given the noisy chunk, over the steps that are drawn."""
    gaussian = mixture(torch.tensor([[0.5, -1.0]]), torch.ones(1), 0.6)
    expert = optimal(gaussian, prediction=prediction)
    generator, count = torch.Generator().manual_seed(0), 100_000
    chunk, valid = gaussian.draw(count, generator), torch.ones(count, 1, dtype=torch.bool)
    loss, _ = expert.drawn_loss(torch.zeros(count, 1, 8), chunk, valid, generator)
    a, b = expert.schedule.signal[1:].double(), expert.schedule.noise[1:].double()
    total = (a * 0.6) ** 2 + b**2
    left = {"epsilon": (a * 0.6) ** 2, "sample": (b * 0.6) ** 2, "v": 0.6**2 * (a**2 + b**2) ** 2}
    often = torch.arange(len(a)).double() * 2 + 1  # in proportion to how much is noise
    expected = (often * left[prediction] / total).sum() / often.sum()
    assert float(loss) == pytest.approx(float(expected), rel=0.02)


def test_the_section_of_params_is_the_constructor():
    params = DiffusionParams()
    expert = DiffusionActionExpert(dim=8, layers=1, heads=1, **params.model_dump())
    assert expert.schedule.timesteps == 100
    assert (expert.prediction, expert.draws) == (params.prediction, params.draws)
    assert expert.steps == expert.schedule.steps(params.sampling_steps)
