from dataclasses import replace

import pytest
import torch

from pipeline.base.config import FeatureEncoderParams, TrainHeadParams
from pipeline.base.errors import ConfigError
from pipeline.policy.ages import fourier
from pipeline.policy.encoders import (
    FeatureEncoder,
    FeaturePooler,
    MeanFeatureEncoder,
    build_encoders,
)
from pipeline.policy.shape import PolicyShape, slot_places


@pytest.fixture
def encoder():
    return FeatureEncoder(5, 16, 24)


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


def test_ages_up_to_half_a_minute_differ():
    waves = fourier(torch.linspace(0.0, 30.0, 301))
    distances = torch.cdist(waves, waves) + 10 * torch.eye(301)
    assert distances.min() > 0.1


def test_cost_stays_sane_with_many_slots_and_width_with_one():
    with torch.device("meta"):
        grid, mean = FeatureEncoder(81, 2048), FeatureEncoder(1, 2048)
    assert sum(p.numel() for p in grid.parameters()) < 4e6
    assert (grid.width, mean.width) == (64, 512)


def slots(layers=("vision", 3), views=("A", "B"), side=3):
    """The documents of a mean, and of tokens of each view, in each layer."""
    cells = [[row, column] for row in range(side) for column in range(side)]
    places = [{"pooling": "view_mean", "view": view} for view in views]
    places += [
        {"pooling": "tokens", "view": view, "cell": cell} for view in views for cell in cells
    ]
    return [{"layer": layer, "norm": False, **place} for layer in layers for place in places]


def shape_of(documents):
    places = slot_places(documents)
    return PolicyShape(len(documents), 16, 0, 4, 3, ("other",) * 3, places=places)


def pooler(documents=None, **params):
    params = FeatureEncoderParams.model_validate({"queries": 3, "dim": 8, "heads": 2} | params)
    return FeaturePooler(shape_of(documents or slots()), params, state_dim=5).eval()


def seen(batch=2, count=40):
    return torch.randn(batch, count, 16), torch.ones(batch, count, dtype=torch.bool)


def test_places_say_which_layer_view_and_part_a_slot_shows():
    shape = shape_of(slots())
    assert (shape.layers, len(shape.places)) == (2, 20)
    assert shape.places[0].center is None and shape.places[0].view == "A"
    assert shape.places[2].center == (1 / 6, 1 / 6) and shape.places[10].center == (5 / 6, 5 / 6)
    # The tokens of a view and layer share their statistics; other slots have their own.
    assert shape.statistics_of[:4] == (0, 1, 2, 2) and shape.statistics_of[20:23] == (4, 5, 6)
    assert shape.channels["features"] == (8, 16)


READERS = {
    "linear": lambda: FeatureEncoder(40, 16, 24),
    "mean": lambda: MeanFeatureEncoder(2, 16),
    "pooler": pooler,
}


@pytest.mark.parametrize("kind", READERS)
def test_no_reader_sees_an_invalid_slot(kind):
    encoder = READERS[kind]()
    features, valid = seen()
    valid[0, ::3], valid[1] = False, False
    changed = features.masked_fill(~valid.unsqueeze(-1), torch.nan)
    age = torch.rand(2)
    tokens = encoder(features, valid, age)
    assert torch.equal(tokens, encoder(changed, valid, age)) and tokens.isfinite().all()
    tokens.square().sum().backward()
    gradients = [p.grad for p in encoder.parameters() if p.grad is not None]
    assert gradients and all(gradient.isfinite().all() for gradient in gradients)


def test_the_mean_reader_reads_the_mean_of_each_layer():
    encoder = MeanFeatureEncoder(2, 16)
    features, valid = seen(1)
    valid[0, :7] = False
    means = torch.stack([features[0, 7:20].mean(dim=0), features[0, 20:].mean(dim=0)])[None]
    both, age = torch.ones(1, 2, dtype=torch.bool), torch.ones(1)
    plain = FeatureEncoder.forward(encoder, means, both, age)
    torch.testing.assert_close(encoder(features, valid, age), plain)


def test_the_pooler_does_not_grow_with_its_slots():
    few, many = pooler(slots(side=2)), pooler(slots(side=17))
    assert [p.shape for p in few.parameters()] == [p.shape for p in many.parameters()]
    assert many(*seen(count=1160), torch.rand(2)).shape == (2, 3, 8)


def test_the_pooler_knows_where_a_token_stands():
    features, valid = torch.zeros(2, 40, 16), torch.ones(2, 40, dtype=torch.bool)
    features[0, 2:3], features[1, 10:11] = 1.0, 1.0  # first and last token of view A
    encoder = pooler()
    tokens = encoder(features, valid, torch.zeros(2))
    assert (tokens[0] - tokens[1]).abs().max() > 1e-4


def test_the_pooler_mixes_layers_by_learned_shares():
    encoder, (features, valid) = pooler(), seen()
    changed = features.clone()
    changed[:, :20] += 1.0  # the first layer
    age = torch.zeros(2)
    assert not torch.allclose(encoder(features, valid, age), encoder(changed, valid, age))
    alike = features[:, :20].repeat(1, 2, 1)
    even = encoder(alike, valid, age)
    encoder.mixture.data = torch.tensor([-1e4, 0.0])
    assert torch.allclose(encoder(features, valid, age), encoder(changed, valid, age))
    torch.testing.assert_close(encoder(alike, valid, age), even)  # the shares sum to 1


def test_the_state_directs_the_queries_and_never_becomes_a_value():
    encoder, (features, valid), age = pooler(), seen(), torch.zeros(2)
    states = torch.randn(2, 2, 1, 5) * 10
    first, second = (encoder(features, valid, age, None, state) for state in states)
    assert torch.equal(first, second)  # its gate is 0 at first
    encoder.gate.data.fill_(1.0)
    first, second = (encoder(features, valid, age, None, state) for state in states)
    assert not torch.allclose(first, second)
    # Where all keys are equal, there is nowhere to look, and the state changes nothing.
    for part in (encoder.where.weight, *(embedding.weight for embedding in encoder.kinds)):
        part.data.zero_()
    alike = torch.randn(2, 1, 16).expand(-1, 40, -1)
    first, second = (encoder(alike, valid, age, None, state) for state in states)
    torch.testing.assert_close(first, second)


def test_readers_need_to_know_the_places():
    unknown = PolicyShape(40, 16, 0, 0, 3, ("other",) * 3)
    params = TrainHeadParams.model_validate({"feature_encoder": {"kind": "pooler"}})
    with pytest.raises(ConfigError, match=r"feature_encoder\.kind pooler: .*Train from a store"):
        build_encoders(params, unknown)


@pytest.mark.parametrize("kind", READERS)
def test_a_history_of_rows_is_read_row_by_row(kind):
    documents = slots(side=2)
    shape = replace(shape_of(documents), history=2)
    params = TrainHeadParams.model_validate(
        {"feature_encoder": {"kind": kind, "queries": 3, "dim": 8, "heads": 2}}
    )
    encoder = build_encoders(params, shape)[0]["features"]
    features, valid = seen(1, 2 * len(documents))
    age = torch.zeros(1)
    tokens = encoder(features, valid, age)
    swapped = features.view(1, 2, len(documents), 16).flip(1).flatten(1, 2)
    assert not torch.allclose(tokens, encoder(swapped, valid, age))  # it knows which is newer
    valid[:, len(documents) :] = False
    changed = features.clone()
    changed[:, len(documents) :] = torch.nan
    assert torch.equal(encoder(features, valid, age), encoder(changed, valid, age))
