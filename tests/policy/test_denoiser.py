"""The network under diffusion and flow matching."""

import pytest
import torch

from pipeline.policy.denoiser import Denoiser


@pytest.fixture
def denoiser():
    return Denoiser(horizon=5, action_dim=3, dim=16, layers=2, heads=2, dropout=0.0)


@pytest.fixture
def inputs():
    return torch.randn(4, 5, 3), torch.rand(4), torch.randn(4, 6, 16)


def test_every_input_matters_to_every_step(denoiser, inputs):
    said = denoiser(*inputs)
    assert said.shape == (4, 5, 3)
    for place in range(3):
        changed = list(inputs)
        changed[place] = changed[place] + 0.1
        assert ((denoiser(*changed) - said).abs().amax(dim=2) > 0).all()


def test_times_a_thousandth_apart_differ(denoiser):
    """A schedule of 1000 steps has such times."""
    times = torch.linspace(0, 1, 1001)
    waves = times.unsqueeze(-1) * denoiser.frequencies
    waves = torch.cat([waves.sin(), waves.cos()], dim=-1)
    distance = torch.cdist(waves, waves) + 10 * torch.eye(len(times))
    assert distance.min() > 1


def test_a_prepared_context_is_the_context(denoiser, inputs):
    noisy, time, context = inputs
    prepared = denoiser.prepare(context)
    assert torch.equal(denoiser(noisy, time, prepared), denoiser(noisy, time, context))
