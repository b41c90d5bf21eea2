"""State and sensor are summarised from what was known at the tick."""

import numpy as np
import pytest

from pipeline.base.errors import NumericsError
from pipeline.evaluate.probe.inputs import LIMIT, STILL, past_actions, reduce, summarize
from pipeline.store import FeatureStore
from tests.evaluate.probe.conftest import limited

TICKS = np.arange(0, 180, 7)
FOLD = np.stack([TICKS // 30 % 3, TICKS // 30 % 2])


def test_last_mean_and_spread_of_the_causal_window(store: FeatureStore) -> None:
    values = summarize(store, "sensor", TICKS, FOLD, 20)
    ends = store.array("tick/sensor_end")[TICKS]
    starts = store.array("episode/sensor_start")[TICKS // 30]
    readings = store.array("sensor/values").astype(np.float64)
    windows = [
        readings[max(first, end - 20) : end] for first, end in zip(starts, ends, strict=True)
    ]
    expected = np.stack([np.concatenate([w[-1], w.mean(0), w.std(0)]) for w in windows])
    expected = limited(expected, FOLD)
    # Units are all alike here, so a stream's channels are one group of each summary.
    assert values.shape == (len(TICKS), 3 * 5 + 1)
    assert summarize(store, "state", TICKS, FOLD, 100).shape == (len(TICKS), 3 * 4 + 1)
    np.testing.assert_allclose(values[:, :15], expected, atol=1e-4)
    assert (values[:, 15] == 1).all()


def test_past_actions_are_of_the_two_ticks_before_in_the_episode(store: FeatureStore) -> None:
    ticks = np.arange(60)
    inputs = past_actions(store, ticks, (ticks // 30)[None])
    action = store.array("tick/action").astype(np.float64)
    assert inputs.shape == (60, 2 * 5)
    for back in (1, 2):
        there = ticks % 30 >= back
        column = inputs[:, 5 * (back - 1)]
        assert (column[~there] == 0).all()
        known = action[ticks[there] - back, 0]
        assert np.corrcoef(column[there], known)[0, 1] == pytest.approx(1)
    store.array("tick/action")[59:] = 1e3
    np.testing.assert_array_equal(past_actions(store, ticks, (ticks // 30)[None]), inputs)


def test_ticks_without_a_reading_say_so(store: FeatureStore) -> None:
    store.array("tick/sensor_end")[30:60] = store.array("episode/sensor_start")[1]
    values = summarize(store, "sensor", TICKS, FOLD, 20)
    missing = TICKS // 30 == 1
    assert (values[missing, :16] == 0).all()
    assert (values[~missing, 15] == 1).all()
    assert np.abs(values[~missing, :15].mean(0)).max() < 1e-5


def test_a_force_is_not_lost_beside_a_wide_scan(tiny_store, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("pipeline.evaluate.probe.inputs.STREAM_WIDTH", 2)
    store = FeatureStore.open(tiny_store(tmp_path, sensor_channels=9, state_dim=0))
    store.streams["sensor"]["units"][4] = "N"
    values = summarize(store, "sensor", TICKS, FOLD, 1)
    assert values.shape[1] == 3 * (2 + 1) + 1
    force = store.array("sensor/values")[store.array("tick/sensor_end")[TICKS] - 1, 4]
    correlations = [abs(np.corrcoef(force, column)[0, 1]) for column in values[:, :3].T]
    assert max(correlations) > 0.9999


def test_a_reading_that_is_no_number_is_named(store: FeatureStore) -> None:
    store.array("sensor/values")[store.array("tick/sensor_end")[35] - 1, 2] = np.nan
    with pytest.raises(NumericsError, match=r"right/episode_001, sensor reading 47 .*'sensor_2'"):
        summarize(store, "sensor", np.array([5, 35]), np.array([[0, 1]]), 20)


def test_main_directions_hold_what_varies() -> None:
    rng = np.random.default_rng(0)
    sample = rng.normal(size=(60, 2)) @ rng.normal(size=(2, 30))
    fold = np.arange(60)[None] % 3
    reduced = reduce(sample, fold, 2)
    assert reduced.shape == (60, 2)
    standard = (sample - sample.mean(0)) / sample.std(0)
    weights, *_ = np.linalg.lstsq(reduced, standard, rcond=None)
    np.testing.assert_allclose(reduced @ weights, standard, atol=1e-9)
    np.testing.assert_array_equal(reduced, reduce(sample, fold, 2))
    assert reduce(sample[:3], fold[:, :3], 8).shape == (3, 3)


@pytest.mark.parametrize("width", [5, 3])
def test_what_moves_where_others_rest_stays_within_limits(width: int) -> None:
    """Of five recordings: a joint that moves in one, one that is elsewhere in one, a spike."""
    rng = np.random.default_rng(0)
    fold = np.repeat(np.arange(5), 40)
    x = rng.normal(size=(200, 5))
    x[:, 1] = 1.6 + np.where(fold == 2, 0.2, 1e-6) * x[:, 1]
    x[:, 2] = np.where(fold == 3, 9.0, 1.0) + 0.5 * x[:, 2]
    x[17, 3] = 40.0
    x[:, 4] = np.where(np.isin(fold, (1, 4)), 1.0, 1e-6) * x[:, 4]
    z = reduce(x, fold[None], width)
    assert z.shape == (200, width)
    np.testing.assert_allclose(z.mean(0), 0, atol=1e-9)
    for held in range(5):
        trained = z[fold != held]
        spread = trained.std(0)
        used = spread > STILL
        apart = np.abs(z[fold == held] - trained.mean(0))[:, used] / spread[used]
        assert apart.max(initial=0) < 2 * LIMIT
    if width == 5:
        assert (z.std(0) > 0).tolist() == [True, False, True, True, True]
        np.testing.assert_allclose(z, limited((x - x.mean(0)) / x.std(0), fold[None]), atol=1e-9)
