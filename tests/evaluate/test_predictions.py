"""What is judged of a policy that samples, and what the feed changes of what it sees."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.special import erf

from pipeline.evaluate.ablation import feed_maker
from pipeline.store import FeatureStore
from pipeline.train import predictions
from pipeline.train.batches import NO_LAGS, Lags, Windows
from pipeline.train.predictions import Predictions, predict

WINDOWS = Windows(horizon=4, sensor_window=2, state_window=2)
TICKS = np.arange(30, 51)


class Noisy(torch.nn.Module):
    """Each chunk is one draw from a standard normal distribution, the whole chunk long."""

    stochastic = True

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(1))
        self.asked: list[int] = []

    def sample(self, batch, samples=1, generator=None):
        self.asked.append(samples)
        shape = (samples, len(batch), 1, 1)
        return torch.randn(shape, generator=generator).expand(-1, -1, 4, 5) * self.weight


class NewestReading(torch.nn.Module):
    stochastic = False

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(1))
        self.asked: list[int] = []

    def sample(self, batch, samples=1, generator=None):
        self.asked.append(samples)
        return batch.sensor[None, :, -1:, :1].expand(samples, -1, 4, 5) * self.weight


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


def test_the_noise_is_of_the_batch_so_that_its_size_decides_too(store: FeatureStore) -> None:
    at_once = predict(Noisy(), store, TICKS, WINDOWS, 64, samples=4)  # type: ignore[arg-type]
    assert not np.array_equal(at_once.predicted, run(Noisy(), store, 4).predicted)


def test_no_more_chunks_at_once_than_memory_is_promised(
    store: FeatureStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(predictions, "_CHUNKS_AT_ONCE", 16)
    policy = Noisy()
    found = run(policy, store, 5)
    # Two whole batches of 8 ticks, then one of 5.
    assert policy.asked == [2, 2, 1] * 2 + [3, 2]
    assert found.sampled is not None


def test_a_policy_that_does_not_sample_is_asked_once(store: FeatureStore) -> None:
    policy = NewestReading()
    run(policy, store, 16)
    assert policy.asked == [1, 1, 1]


def test_the_policy_sees_what_the_feed_hands_out(store: FeatureStore) -> None:
    device = torch.device("cpu")
    seen = run(NewestReading(), store, 1).predicted[:, 0, 0]
    readings = store.array("sensor/values")[:, 0]
    end = store.array("tick/sensor_end")[TICKS]
    assert np.array_equal(seen, readings[end - 1])
    late = run(NewestReading(), store, 1, feed=feed_maker(store, WINDOWS, device, Lags(0, 0.1)))
    expected = store.gather(TICKS, sensor_window=2, sensor_lag_s=0.1).sensor[:, -1, 0]
    assert np.array_equal(late.predicted[:, 0, 0], expected.numpy())
    assert not np.array_equal(late.predicted[:, 0, 0], seen)

    calls = []

    def negated(draw, batch):
        calls.append(len(draw.ticks))
        return replace(batch, sensor=-batch.sensor)

    altered = run(
        NewestReading(), store, 1, feed=feed_maker(store, WINDOWS, device, NO_LAGS, negated)
    )
    assert np.array_equal(altered.predicted[:, 0, 0], -seen)
    assert calls == [8, 8, 5]
    assert np.array_equal(altered.recorded, late.recorded)
