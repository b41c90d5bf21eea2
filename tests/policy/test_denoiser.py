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


def test_steps_know_their_place(denoiser, inputs):
    noisy, time, context = inputs
    said = denoiser(noisy[:, :1].expand(-1, 5, -1), time, context)
    assert (said[:, 1:] - said[:, :1]).abs().amax() > 1e-4


def test_what_stands_in_masked_steps_is_not_seen(denoiser, inputs):
    noisy, time, context = inputs
    valid = torch.arange(5) < torch.tensor([[5], [3], [1], [0]])
    changed = torch.where(valid.unsqueeze(-1), noisy, torch.tensor(50.0))
    said, other = (denoiser(x, time, context, valid) for x in (noisy, changed))
    torch.testing.assert_close(said[valid], other[valid])
    assert torch.isfinite(said).all()


def test_times_a_thousandth_apart_differ(denoiser, inputs):
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
