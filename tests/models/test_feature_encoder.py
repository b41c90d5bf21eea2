import pytest
import torch

from pipeline.models import FeatureEncoder
from pipeline.models.feature_encoder import fourier


@pytest.fixture
def encoder() -> FeatureEncoder:
    return FeatureEncoder(5, 16, 24)


def test_shape(encoder: FeatureEncoder) -> None:
    valid = torch.ones(3, 5, dtype=torch.bool)
    assert encoder(torch.randn(3, 5, 16), valid, torch.rand(3)).shape == (3, 24)


@pytest.mark.parametrize("content", [7.0, float("nan")])
def test_invalid_slots_never_reach_the_output(encoder: FeatureEncoder, content: float) -> None:
    features, age = torch.randn(2, 5, 16), torch.rand(2)
    valid = torch.tensor([[True, False, True, False, True], [False] * 5])
    changed = features.masked_fill(~valid.unsqueeze(-1), content)
    assert torch.equal(encoder(features, valid, age), encoder(changed, valid, age))


def test_a_missing_slot_is_a_learned_embedding_of_its_own(encoder: FeatureEncoder) -> None:
    valid = torch.tensor([[True, False, True, True, True]])
    encoder(torch.randn(1, 5, 16), valid, torch.rand(1)).square().sum().backward()
    assert encoder.missing.grad is not None
    reached = encoder.missing.grad.abs().sum(dim=-1) > 0
    assert reached.tolist() == [False, True, False, False, False]


def test_a_slot_keeps_its_place(encoder: FeatureEncoder) -> None:
    """Pooling over slots would make these equal."""
    features, valid, age = torch.randn(1, 5, 16), torch.ones(1, 5, dtype=torch.bool), torch.zeros(1)
    moved = features.roll(1, dims=1)
    assert (encoder(features, valid, age) - encoder(moved, valid, age)).abs().max() > 1e-2


def test_age_tells_apart_a_tick_from_the_next(encoder: FeatureEncoder) -> None:
    features, valid = torch.randn(1, 5, 16).expand(2, -1, -1), torch.ones(2, 5, dtype=torch.bool)
    fresh, stale = encoder(features, valid, torch.tensor([0.0, 0.1]))
    assert (fresh - stale).abs().max() > 1e-2


def test_ages_up_to_half_a_minute_differ() -> None:
    waves = fourier(torch.linspace(0.0, 30.0, 301))
    distances = torch.cdist(waves, waves) + 10 * torch.eye(301)
    assert distances.min() > 0.1


def test_cost_stays_sane_with_many_slots_and_width_with_one() -> None:
    with torch.device("meta"):
        grid, mean = FeatureEncoder(81, 2048, 512), FeatureEncoder(1, 2048, 512)
    assert sum(p.numel() for p in grid.parameters()) < 4e6
    assert mean.squeeze.out_features == 512
