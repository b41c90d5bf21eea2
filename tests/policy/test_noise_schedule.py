"""The schedule against the papers' formulas and against Bayes' rule."""

import math
from itertools import pairwise

import pytest
import torch

from pipeline.policy.diffusion import NoiseSchedule


@pytest.fixture
def schedule():
    """In double precision, so that only the formulas differ; still the float32 schedule."""
    return NoiseSchedule(100).double()


@pytest.fixture
def sample():
    return torch.randn(100, 3, 2, dtype=torch.float64)


@pytest.fixture
def epsilon():
    return torch.randn(100, 3, 2, dtype=torch.float64)


EVERY = torch.arange(1, 101)


def test_cosine_is_equation_17():
    def f(t: int) -> float:
        return math.cos((t / 100 + 0.008) / 1.008 * math.pi / 2) ** 2

    expected = torch.tensor([f(t) / f(0) for t in range(100)])
    torch.testing.assert_close(NoiseSchedule(100).alpha_bar[:100], expected)


def test_the_last_beta_of_cosine_is_held():
    alpha_bar = NoiseSchedule(100).alpha_bar.double()
    assert float(1 - alpha_bar[100] / alpha_bar[99]) == pytest.approx(0.999, rel=1e-6)


def test_its_values_come_back_with_the_weights():
    """The seeds' schedule stayed on one device, outside the state dict."""
    trained, fresh = NoiseSchedule(), NoiseSchedule()
    trained.signal *= 0.5
    assert trained.state_dict().keys() == {"alpha_bar", "signal", "noise"}
    fresh.load_state_dict(trained.state_dict())
    assert torch.equal(fresh.signal, trained.signal)


@pytest.mark.parametrize("kind", ["epsilon", "sample", "v"])
def test_each_prediction_gives_back_sample_and_noise(kind, schedule, sample, epsilon):
    noisy = schedule.add_noise(sample, epsilon, EVERY)
    said = schedule.target(kind, sample, epsilon, EVERY)
    found = schedule.sample_of(kind, said, noisy, EVERY)
    torch.testing.assert_close(found, sample, rtol=0, atol=1e-6)
    back = schedule.epsilon_of(found, noisy, EVERY)
    torch.testing.assert_close(back, epsilon, rtol=0, atol=2e-5)
    each = schedule.sample_of(kind, epsilon, sample, torch.full((100,), 37))
    assert torch.equal(each, schedule.sample_of(kind, epsilon, sample, 37)), "one step for all rows"


def test_the_posterior_is_bayes_rule(schedule, sample, epsilon):
    """Precisions of the step to x_t and of the prior N(signal x0, noise^2) add up."""
    noisy = schedule.add_noise(sample, epsilon, EVERY)
    for step in range(2, 101):
        x, x0 = noisy[step - 1 : step], sample[step - 1 : step]
        alpha = schedule.alpha_bar[step] / schedule.alpha_bar[step - 1]
        prior = schedule.noise[step - 1] ** 2
        variance = 1 / (alpha / (1 - alpha) + 1 / prior)
        pull = alpha.sqrt() / (1 - alpha) * x + schedule.signal[step - 1] / prior * x0
        mean, found = schedule.posterior(x0, x, step)
        torch.testing.assert_close(found, variance, rtol=1e-3, atol=0)
        torch.testing.assert_close(mean, variance * pull, rtol=0, atol=2e-3)


def test_ddim_of_eta_one_from_step_to_step_is_the_posterior(schedule, sample):
    """For any pair, also one that no noise explains: what is left of a clipped sample."""
    noisy = 3 * torch.randn_like(sample)
    for step in range(1, 101):
        mean, variance = schedule.ddim(sample, noisy, step, step - 1, 1.0)
        expected_mean, expected_variance = schedule.posterior(sample, noisy, step)
        torch.testing.assert_close(mean, expected_mean, rtol=0, atol=2e-3)
        torch.testing.assert_close(variance, expected_variance, rtol=1e-5, atol=0)


def test_any_number_of_steps_falls_to_zero():
    schedule = NoiseSchedule(100)
    for count in range(1, 101):
        steps = schedule.steps(count)
        assert len(steps) == count + 1
        assert steps[-1] == 0
        assert steps[0] <= 100
        assert all(a > b for a, b in pairwise(steps))


def test_fewer_steps_begin_near_the_top_and_end_at_half_a_share():
    assert NoiseSchedule(100).steps(10) == [98, 88, 77, 67, 57, 46, 36, 26, 15, 5, 0]
