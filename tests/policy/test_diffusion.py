"""Sampling with the best possible network, against closed forms; nothing is trained here."""

from itertools import pairwise

import pytest
import torch

from pipeline.base.config import DiffusionParams
from pipeline.policy.diffusion import DiffusionActionExpert
from tests.policy.optimal import TWO_MODES, Mixture, drawn, optimal


@pytest.mark.parametrize(
    "arguments", [{"sampler": "ddpm"}, {"sampling_steps": 100, "prediction": "v"}], ids=str
)
def test_every_sampler_draws_two_modes(arguments):
    samples = drawn(optimal(DiffusionActionExpert, TWO_MODES, timesteps=200, **arguments))[:, 0]
    distance, mode = (samples[:, None] - TWO_MODES.means).norm(dim=-1).min(dim=1)
    near = distance < 4 * TWO_MODES.spread
    assert near.float().mean() > 0.99
    for index, (weight, mean) in enumerate(zip(TWO_MODES.weights, TWO_MODES.means, strict=True)):
        own = mode == index
        torch.testing.assert_close(own.float().mean(), weight, rtol=0, atol=0.025)
        torch.testing.assert_close(samples[own].mean(0), mean, rtol=0, atol=0.02)
        spread = float(samples[own & near].std(0).mean())
        assert spread == pytest.approx(TWO_MODES.spread, rel=0.15)


@pytest.mark.parametrize("eta", [0.0, 0.6])
def test_samples_of_a_gaussian_have_the_mean_and_spread_that_theory_gives(eta):
    """The best network is linear there, so each step maps mean and variance in closed form."""
    gaussian = Mixture(torch.tensor([[1.2]]), torch.ones(1), 0.4)
    expert = optimal(DiffusionActionExpert, gaussian, sampling_steps=10, eta=eta, clip=None)
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


def test_eta_zero_draws_its_first_noise_and_no_more():
    generator, apart = torch.Generator().manual_seed(0), torch.Generator().manual_seed(0)
    optimal(DiffusionActionExpert, TWO_MODES).act(torch.zeros(7, 1, 8), generator)
    torch.randn(7, 1, 2, generator=apart)
    assert torch.equal(generator.get_state(), apart.get_state())


@pytest.mark.parametrize(("prediction", "sampler"), [("epsilon", "ddpm"), ("v", "ddim")])
def test_a_network_gone_wild_stays_within_the_clip(prediction, sampler):
    """The seeds clamped x0 and then took the step from the unclamped one."""
    arguments = {"prediction": prediction, "sampler": sampler, "clip": 1.5}
    expert = optimal(DiffusionActionExpert, TWO_MODES, **arguments)
    expert.denoiser.forward = lambda noisy, *_: torch.full_like(noisy, 1e6)
    chunk = drawn(expert, 50)
    torch.testing.assert_close(chunk.abs(), torch.full_like(chunk, 1.5), rtol=1e-3, atol=0)


def test_none_does_not_clip():
    far = Mixture(torch.tensor([[9.0, -9.0]]), torch.ones(1), 0.1)
    clipped = optimal(DiffusionActionExpert, far, sampling_steps=100)
    assert drawn(clipped, 500).abs().mean() < 6
    expert = optimal(DiffusionActionExpert, far, sampling_steps=100, clip=None)
    free = drawn(expert, 500)
    torch.testing.assert_close(free.mean(0, keepdim=True), far.means[None], rtol=0, atol=0.05)


@pytest.mark.parametrize("prediction", ["epsilon", "sample", "v"])
def test_the_best_network_has_the_smallest_loss_there_is(prediction):
    """The variance of the target given the noisy chunk, over the steps that are drawn."""
    gaussian = Mixture(torch.tensor([[0.5, -1.0]]), torch.ones(1), 0.6)
    expert = optimal(DiffusionActionExpert, gaussian, prediction=prediction)
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
