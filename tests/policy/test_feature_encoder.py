import pytest
import torch

from pipeline.policy.ages import fourier
from pipeline.policy.encoders import FeatureEncoder


@pytest.fixture
def encoder():
    return FeatureEncoder(5, 16, 24)


@pytest.mark.parametrize("content", [7.0, float("nan")])
def test_invalid_slots_never_reach_the_output(encoder, content):
    features, age = torch.randn(2, 5, 16), torch.rand(2)
    valid = torch.tensor([[True, False, True, False, True], [False] * 5])
    changed = features.masked_fill(~valid.unsqueeze(-1), content)
    assert torch.equal(encoder(features, valid, age), encoder(changed, valid, age))


def test_a_missing_slot_is_a_learned_embedding_of_its_own(encoder):
    valid = torch.tensor([[True, False, True, True, True]])
    encoder(torch.randn(1, 5, 16), valid, torch.rand(1)).square().sum().backward()
    assert encoder.missing.grad is not None
    reached = encoder.missing.grad.abs().sum(dim=-1) > 0
    assert reached.tolist() == [False, True, False, False, False]


def test_what_is_not_there_has_no_age(encoder):
    valid = torch.tensor([[True, False, True, True, True]]).expand(2, -1)
    tokens = encoder(torch.randn(1, 5, 16).expand(2, -1, -1), valid, torch.tensor([0.0, 0.3]))
    differs = (tokens[0] - tokens[1]).abs().amax(dim=-1) > 1e-3
    assert differs.tolist() == valid[0].tolist()


def test_an_age_of_nothing_reaches_no_gradient(encoder):
    features = torch.randn(2, 5, 16)
    valid = torch.tensor([[True, False, True, False, True], [False] * 5])
    found = []
    for nothing in (0.3, torch.nan):
        encoder.zero_grad()
        tokens = encoder(features, valid, torch.tensor([0.2, nothing]))
        tokens.square().sum().backward()
        gradients = [p.grad.clone() for p in encoder.parameters() if p.grad is not None]
        found.append([tokens.detach(), *gradients])
    assert len(found[0]) == 1 + len(list(encoder.parameters()))
    assert all(torch.equal(*pair) and pair[0].isfinite().all() for pair in zip(*found, strict=True))


def test_a_slot_stands_in_its_own_token(encoder):
    features, valid, age = torch.randn(1, 5, 16), torch.ones(1, 5, dtype=torch.bool), torch.zeros(1)
    changed = features.clone()
    changed[:, 2] += 1.0
    differs = (encoder(changed, valid, age) - encoder(features, valid, age)).abs().amax(dim=-1) > 0
    assert differs.tolist() == [[False, False, True, False, False]]


def test_equal_cells_in_different_places_are_told_apart(encoder):
    features, valid = torch.randn(1, 1, 16).expand(1, 5, 16), torch.ones(1, 5, dtype=torch.bool)
    tokens = encoder(features, valid, torch.zeros(1))[0]
    assert (torch.cdist(tokens, tokens) + torch.eye(5)).min() > 1e-2


def test_ages_up_to_half_a_minute_differ():
    waves = fourier(torch.linspace(0.0, 30.0, 301))
    distances = torch.cdist(waves, waves) + 10 * torch.eye(301)
    assert distances.min() > 0.1


def test_cost_stays_sane_with_many_slots_and_width_with_one():
    with torch.device("meta"):
        grid, mean = FeatureEncoder(81, 2048), FeatureEncoder(1, 2048)
    assert sum(p.numel() for p in grid.parameters()) < 4e6
    assert (grid.width, mean.width) == (64, 512)
