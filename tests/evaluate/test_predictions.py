"""What is judged of a policy that samples, and what the feed changes of what it sees."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.special import erf

from pipeline.base.errors import NumericsError
from pipeline.store import FeatureStore
from pipeline.train import predictions
from pipeline.train.batches import Lags, Windows
from pipeline.train.predictions import Predictions, predict

WINDOWS = Windows(horizon=4, sensor_window=2, state_window=2)
TICKS = np.arange(30, 51)


class StandIn(torch.nn.Module):
    """As much of a policy as `predict` needs; remembers how many samples it was asked for."""

    stochastic = False

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(1))
        self.asked: list[int] = []

    def sample(self, batch, samples=1, generator=None):
        self.asked.append(samples)
        return self.chunks(batch, samples, generator) * self.weight

    def chunks(self, batch, samples, generator):
        """Acts by the newest reading, so that what it was given shows in what comes out."""
        return batch.sensor[None, :, -1:, :1].expand(samples, -1, 4, 5)


class Noisy(StandIn):
    """Each chunk is one draw from a standard normal distribution, the whole chunk long."""

    stochastic = True

    def chunks(self, batch, samples, generator):
        shape = (samples, len(batch), 1, 1)
        return torch.randn(shape, generator=generator).expand(-1, -1, 4, 5)


def run(policy: torch.nn.Module, store: FeatureStore, samples: int, **more) -> Predictions:
    return predict(policy, store, TICKS, WINDOWS, 8, samples=samples, **more)  # type: ignore[arg-type]


def test_the_error_is_that_of_one_sample_with_the_noise_of_many(store: FeatureStore) -> None:
    """A draw misses what is recorded by that and its own variance; the mean of many would not."""
    one, many = run(Noisy(), store, 1), run(Noisy(), store, 400)
    assert one.sampled is None
    assert 0.5 < one.predicted[:, 0, 0].std() < 1.5
    assert 0.5 < many.predicted[:, 0, 0].std() < 1.5, "the first sample, no mean"
    here = many.recorded
    # Of a normal distribution around 0 (the mean of a folded one), and not |recorded|.
    expected = np.sqrt(2 / np.pi) * np.exp(-(here**2) / 2) + here * erf(here / np.sqrt(2))
    assert many.error.mean() == pytest.approx(expected.mean(), rel=0.05)
    assert np.abs(many.error - np.abs(many.predicted - here)).max() > 0.5
    assert np.array_equal(many.error, run(Noisy(), store, 400).error)


def test_no_more_chunks_at_once_than_memory_is_promised(store, monkeypatch):
    monkeypatch.setattr(predictions, "_CHUNKS_AT_ONCE", 16)
    policy = Noisy()
    run(policy, store, 5)
    # Two whole batches of 8 ticks, then one of 5.
    assert policy.asked == [2, 2, 1] * 2 + [3, 2]


def test_the_policy_sees_late_and_altered_batches(store: FeatureStore) -> None:
    seen = run(StandIn(), store, 1).predicted[:, 0, 0]
    late = run(StandIn(), store, 1, lags=Lags(0, 0.1))
    expected = store.gather(TICKS, sensor_window=2, sensor_lag_s=0.1).sensor[:, -1, 0]
    assert np.array_equal(late.predicted[:, 0, 0], expected.numpy())
    assert not np.array_equal(late.predicted[:, 0, 0], seen)

    calls = []

    def negated(batch):
        calls.append(len(batch))
        return replace(batch, sensor=-batch.sensor)

    altered = run(StandIn(), store, 1, alter=negated)
    assert np.array_equal(altered.predicted[:, 0, 0], -seen)
    assert calls == [8, 8, 5]
    assert np.array_equal(altered.recorded, late.recorded)


def test_predictions_belong_to_their_ticks(store: FeatureStore) -> None:
    ticks = np.arange(25, 65)
    found = predict(StandIn(), store, ticks, WINDOWS, 7)  # type: ignore[arg-type]
    newest = store.array("tick/sensor_end")[ticks] - 1
    assert np.array_equal(found.predicted[:, 0, 0], store.array("sensor/values")[newest, 0])
    expected = store.gather(ticks, horizon=4)
    assert np.array_equal(found.recorded, expected.action.numpy())
    assert np.array_equal(found.valid, expected.action_valid.numpy())
    assert found.episodes.tolist() == [0] * 5 + [1] * 30 + [2] * 5


@pytest.mark.parametrize("what", ["recorded action", "action of the policy"])
def test_a_number_that_is_none_is_named_by_episode_tick_and_time(tiny_store, tmp_path, what):
    store = FeatureStore.open(tiny_store(tmp_path))
    if what == "recorded action":
        store.array("tick/action")[37, 3] = np.nan
    else:
        store.array("sensor/values")[store.array("tick/sensor_end")[37] - 1, 0] = np.inf
    with pytest.raises(NumericsError, match=what) as caught:
        predict(StandIn(), store, np.arange(30, 60), WINDOWS, 8)  # type: ignore[arg-type]
    assert "right/episode_001, tick 7 (at 0.700 s)" in str(caught.value)
    # Beyond the end of an episode nothing was recorded, so nothing can be wrong there.
    assert len(predict(StandIn(), store, np.arange(26, 30), WINDOWS, 8).ticks)  # type: ignore[arg-type]
