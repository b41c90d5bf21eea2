"""The normalisation sees what training may see, once, and nothing else."""

import re
from dataclasses import asdict

import numpy as np
import pytest

from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import NumericsError
from pipeline.policy.attention import right_aligned
from pipeline.store import FeatureStore
from pipeline.store.gather import Batch, Gatherer, Selection
from pipeline.train.batches import Windows
from pipeline.train.statistics import anchored_channels, fit_normalization

WINDOWS = Windows(8, 65, 100, 0.1, 1.0)


def test_statistics_are_those_of_the_training_ticks(store, monkeypatch):
    monkeypatch.setattr("pipeline.train.statistics.CHUNK_BYTES", 500)
    # All of episode 1, and of episode 4 the first 7 ticks: a tail is held out.
    ticks = np.concatenate([np.arange(30, 60), np.arange(120, 127)])
    found = fit_normalization(store, ticks, WINDOWS)

    action = store.array("tick/action")[ticks]
    rows = [*range(10, 20), 40, 41, 42]
    features = store.array("vl/features")[rows]
    sensor = store.array("sensor/values")[[*range(240, 480), *range(960, 960 + 7 * 8)]]
    windows = store.gather(ticks, **asdict(WINDOWS))
    state = windows.state[right_aligned(windows.state_valid, 100)].numpy()
    assert len(state) > 1000
    for name, values in (
        ("action", action),
        ("features", features),
        ("sensor", sensor),
        ("state", state),
    ):
        statistics = getattr(found, name)
        assert statistics.count == len(values), name
        assert statistics.mean == pytest.approx(values.mean(0, np.float64), abs=1e-6), name
        assert statistics.std == pytest.approx(values.std(0, np.float64), abs=1e-6), name


def test_batches_of_states_read_no_features(store, monkeypatch):
    """A thousand rows of tokens are gigabytes."""
    copy, copied = Gatherer.copy, set[str]()

    def seen(gatherer: Gatherer, selection: Selection, batch: Batch) -> None:
        copied.update(selection.rows)
        copy(gatherer, selection, batch)

    monkeypatch.setattr(Gatherer, "copy", seen)
    assert fit_normalization(store, np.arange(30, 60), WINDOWS).state is not None
    assert copied == {"action"}


@pytest.mark.parametrize("chunk_bytes", [1, 2**26])
def test_features_are_counted_over_all_variants(store_saying, tmp_path, monkeypatch, chunk_bytes):
    monkeypatch.setattr("pipeline.train.statistics.CHUNK_BYTES", chunk_bytes)
    store = store_saying(tmp_path, {"feature_spec": {"variants": 3}}, slots=6)
    store.array("vl/slot_valid")[10:13, [1, 3, 5]] = 0
    found = fit_normalization(store, np.arange(30, 60), WINDOWS).features
    assert found is not None
    assert found.mean.shape == (2, 8)
    assert found.count == 3 * 10
    for slot, rows in ((0, range(10, 20)), (1, range(13, 20))):
        values = store.array("vl/features")[rows, slot::2].reshape(-1, 8)
        assert found.mean[slot] == pytest.approx(values.mean(0, np.float64), abs=1e-6)
        assert found.std[slot] == pytest.approx(values.std(0, np.float64), abs=1e-6)

    store.array("vl/features")[12, 5, 3] = np.nan
    fit_normalization(store, np.arange(30, 60), WINDOWS)  # there, that slot is not valid
    store.array("vl/features")[14, 5, 3] = np.nan
    with pytest.raises(
        NumericsError, match=r"episode_001, VL row 4 .*, channel 1, 3 of variant 2, in "
    ):
        fit_normalization(store, np.arange(30, 60), WINDOWS)


def test_absent_streams_have_none_and_bfloat16_is_read(tiny_store, tmp_path):
    store = FeatureStore.open(
        tiny_store(tmp_path, sensor_channels=0, state_dim=0, dtype="bfloat16")
    )
    found = fit_normalization(store, np.arange(store.ticks), WINDOWS)
    assert found.sensor is None
    assert found.state is None
    assert found.features is not None
    batch = store.gather(np.arange(0, store.ticks, store.vlm_reuse_count))
    expected = batch.features.double().numpy()
    assert found.features.mean == pytest.approx(expected.mean(0), abs=1e-6)


@pytest.mark.parametrize(
    ("array", "row", "said"),
    [
        ("tick/action", (37, 3), "right/episode_001, tick 7 (at 0.700 s), channel 'da'"),
        ("vl/features", (12, 1, 4), "right/episode_001, VL row 2 (at 0.600 s), channel 1, 4"),
        ("sensor/values", (245, 2), "right/episode_001, sensor reading 5 (at 0.062 s)"),
        ("state/values", (121, 0), "right/episode_001, state reading 1 (at 0.025 s)"),
    ],
)
def test_a_number_that_is_none_is_named_by_episode_and_time(tiny_store, tmp_path, array, row, said):
    store = FeatureStore.open(tiny_store(tmp_path))
    store.array(array)[row] = np.nan
    with pytest.raises(NumericsError, match=re.escape(f"found nan at {said}")):
        fit_normalization(store, np.arange(30, 60), WINDOWS)


def test_threads_change_no_bit(tiny_store, tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.train.statistics.CHUNK_BYTES", 300)
    monkeypatch.setattr("pipeline.policy.normalization._PIECE_VALUES", 40)
    store = FeatureStore.open(tiny_store(tmp_path))
    store.array("vl/slot_valid")[12, 1] = 0
    ticks = np.arange(20, 160)
    alone = fit_normalization(store, ticks, WINDOWS, threads=1).document()
    assert fit_normalization(store, ticks, WINDOWS, threads=3).document() == alone


@pytest.mark.parametrize(
    ("changed", "anchor"),
    [
        ({}, ["dx"]),  # all episodes go down dz, whose depth the sensor tells
        ({"sensor_enabled": False}, ["dx", "dz"]),
        ({"robot_state_enabled": False}, []),
        ({"features_enabled": False}, []),
        ({"anchor": ["dz"]}, ["dz"]),
        ({"anchor": "none"}, []),
    ],
)
def test_anchored_are_translations_that_go_either_way(
    tiny_store, tmp_path, monkeypatch, changed, anchor
):
    store = FeatureStore.open(tiny_store(tmp_path))
    state = {"names": ["x", "z", "a", "gripper"], "units": ["mm", "mm", "deg", ""]}
    streams = store.streams | {"state": store.streams["state"] | state}
    monkeypatch.setattr(FeatureStore, "streams", streams)
    action, episode = store.array("tick/action"), store.episode_of(np.arange(store.ticks))
    action[:, 0], action[:, 2] = np.where(episode % 2, 1.0, -1.0), 1.0
    params = TrainHeadParams.model_validate(changed)
    assert anchored_channels(store, np.arange(store.ticks), params) == anchor


def test_what_rested_in_training_is_no_unit_of_what_moves_later(tiny_store, tmp_path):
    store = FeatureStore.open(tiny_store(tmp_path))
    readings = store.array("state/values")
    readings[:, 1] = readings[:, 1] * 1e-4  # its likes move as before
    fitted = fit_normalization(store, np.arange(30, 60), WINDOWS).state
    assert fitted is not None
    assert fitted.std[1] == pytest.approx(0.05 * np.sort(fitted.std)[-2:].min(), rel=0.5)


def test_angles_are_fitted_as_a_policy_takes_them(store, store_saying, tmp_path):
    state = store.streams["state"] | {"units": ["deg"] * store.state_dim}
    turned = store_saying(tmp_path, {"streams": {"state": state}})
    turned.array("state/values")[:, 0] += 360.0 * np.arange(len(turned.array("state/values")))
    fitted = fit_normalization(turned, np.arange(30, 60), WINDOWS).state
    assert fitted is not None
    assert fitted.mean.shape == (2 * store.state_dim,)
    assert (np.abs(fitted.mean) <= 1).all()
