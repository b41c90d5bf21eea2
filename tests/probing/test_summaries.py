"""State and sensor are summarised from what was known at the tick."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.errors import NumericsError
from pipeline.probing.projection import Projection, main_directions
from pipeline.probing.summaries import summarize
from pipeline.store import FeatureStore

TICKS = np.arange(0, 180, 7)


def test_last_mean_and_spread_of_the_causal_window(store: FeatureStore) -> None:
    values = summarize(store, TICKS, 20, 100).values
    ends = store.array("tick/sensor_end")[TICKS]
    starts = store.array("episode/sensor_start")[TICKS // 30]
    readings = store.array("sensor/values").astype(np.float64)
    windows = [
        readings[max(first, end - 20) : end] for first, end in zip(starts, ends, strict=True)
    ]
    expected = np.stack([np.concatenate([w[-1], w.mean(0), w.std(0)]) for w in windows])
    expected = (expected - expected.mean(0)) / expected.std(0)
    # Units are all alike here, so a stream's channels are one group of each summary.
    assert values.shape == (len(TICKS), 3 * (5 + 4) + 2)
    np.testing.assert_allclose(values[:, :15], expected, atol=1e-4)
    assert (values[:, 15] == 1).all()


def test_nothing_later_than_the_tick_is_read(store: FeatureStore) -> None:
    before = np.array(summarize(store, TICKS[:3], 20, 20).values)
    store.array("sensor/values")[store.array("tick/sensor_end")[TICKS[2]] :] = 1e3
    store.array("state/values")[store.array("tick/state_end")[TICKS[2]] :] = 1e3
    np.testing.assert_array_equal(summarize(store, TICKS[:3], 20, 20).values, before)


def test_ticks_without_a_reading_say_so(store: FeatureStore) -> None:
    store.array("tick/sensor_end")[30:60] = store.array("episode/sensor_start")[1]
    values = summarize(store, TICKS, 20, 20).values
    missing = TICKS // 30 == 1
    assert (values[missing, :16] == 0).all()
    assert (values[~missing, 15] == 1).all()
    assert np.abs(values[~missing, :15].mean(0)).max() < 1e-5


def test_a_force_is_not_lost_beside_a_wide_scan(
    tiny_store: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.probing.summaries.GROUP_WIDTH", 2)
    store = FeatureStore.open(tiny_store(tmp_path, sensor_channels=9, state_dim=0))
    store.streams["sensor"]["units"][4] = "N"
    values = summarize(store, TICKS, 1, 1).values
    assert values.shape[1] == 3 * (2 + 1) + 1
    force = store.array("sensor/values")[store.array("tick/sensor_end")[TICKS] - 1, 4]
    correlations = [abs(np.corrcoef(force, column)[0, 1]) for column in values[:, :3].T]
    assert max(correlations) > 0.9999


def test_no_stream_is_no_column(tiny_store: Callable[..., Path], tmp_path: Path) -> None:
    store = FeatureStore.open(tiny_store(tmp_path, sensor_channels=0, state_dim=0))
    assert summarize(store, TICKS, 5, 5).values.shape == (len(TICKS), 0)


@pytest.mark.parametrize("window", [1, 20])
def test_a_reading_that_is_no_number_is_named(store: FeatureStore, window: int) -> None:
    store.array("sensor/values")[store.array("tick/sensor_end")[35] - 1, 2] = np.nan
    with pytest.raises(NumericsError, match=r"right/episode_001, sensor reading 47 .*'sensor_2'"):
        summarize(store, np.array([5, 35]), window, 20)


def test_main_directions_are_those_of_the_singular_vectors() -> None:
    torch.manual_seed(0)
    sample = torch.randn(60, 5, dtype=torch.float64) @ torch.randn(5, 30, dtype=torch.float64)
    found = main_directions(sample, 5)
    assert torch.dist(found.T @ found, torch.eye(5)) < 1e-12
    assert torch.dist(sample @ found @ found.T, sample) < 1e-9
    assert torch.equal(found, main_directions(sample, 5))
    assert main_directions(sample[:3], 8).shape == (30, 3)


def test_a_channel_that_does_not_vary_is_zero() -> None:
    sample = torch.tensor([[1.0, 7.0], [3.0, 7.0]], dtype=torch.float64)
    assert Projection.fit(sample)(sample).tolist() == [[-1.0, 0.0], [1.0, 0.0]]
