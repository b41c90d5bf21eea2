"""The reader agrees with plain zarr, and gathers what a loop over ticks would gather."""

import pickle
from pathlib import Path

import dask.array
import numpy as np
import pytest
import torch
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import StoreIncomplete, StoreMismatch
from pipeline.store import FeatureStore
from pipeline.store.schema import ARRAY_NAMES


@pytest.fixture(scope="module")
def path(tiny_store, tmp_path_factory) -> Path:
    return tiny_store(tmp_path_factory.mktemp("store"))


@pytest.fixture(scope="module")
def store(path) -> FeatureStore:
    return FeatureStore.open(path)


class TestPlainReaders:
    @pytest.mark.parametrize("name", ARRAY_NAMES)
    def test_zarr_dask_and_numpy_agree_with_the_map(self, path, store, name):
        mapped = store.array(name)
        array = zarr.open_group(path, mode="r")[name]
        assert isinstance(array, zarr.Array)
        assert np.array_equal(array[:], mapped, equal_nan=True)
        lazy = dask.array.from_zarr(str(path), component=name)
        assert np.array_equal(lazy.compute(), mapped, equal_nan=True)
        file = path / name / "c" / "/".join("0" * mapped.ndim)
        flat = np.fromfile(file, mapped.dtype, mapped.size).reshape(mapped.shape)
        assert np.array_equal(flat, mapped, equal_nan=True)

    def test_every_array_is_plain_and_named(self, path):
        for name in ARRAY_NAMES:
            metadata = zarr.open_array(path, path=name, mode="r").metadata.to_dict()
            assert [codec["name"] for codec in metadata["codecs"]] == ["bytes", "crc32c"]
            assert len(metadata["dimension_names"]) == len(metadata["shape"])
            assert metadata["chunk_grid"]["configuration"]["chunk_shape"][0] % 4096 == 0

    def test_bfloat16_is_its_bits_with_an_attribute(self, tiny_store, tmp_path):
        path = tiny_store(tmp_path, dtype="bfloat16")
        array = zarr.open_array(path, path="vl/features", mode="r")
        assert array.dtype == np.uint16
        assert array.attrs["dtype"] == "bfloat16"
        gathered = FeatureStore.open(path).gather([0]).features
        bits = torch.from_numpy(array[:1].astype(np.int32) << 16).view(torch.float32)
        assert torch.equal(gathered.float(), bits)


def reference(store: FeatureStore, tick: int, window: int, horizon: int, lag: int, lag_s: float):
    """What belongs to one tick, by the words of the contract."""
    episode = next(one for one in store.episodes if tick in one.ticks)
    row = max(int(store.array("tick/vl_row")[tick]) - lag, episode.vl_rows.start)
    now = store.array("tick/time")[tick]
    clock = store.array("sensor/time")
    seen = [
        reading
        for reading in episode.readings
        if reading < store.array("tick/sensor_end")[tick] and clock[reading] <= now - lag_s
    ]
    if not lag_s:
        seen = list(range(episode.readings.start, store.array("tick/sensor_end")[tick]))
    seen = seen[-window:]
    values = np.zeros((window, store.sensor_channels), np.float32)
    if seen:
        values[-len(seen) :] = store.array("sensor/values")[seen]
    ahead = [min(tick + step, episode.ticks.stop - 1) for step in range(horizon)]
    return {
        "features": store.array("vl/features")[row],
        "feature_age": now - np.nanmax(store.array("vl/frame_time")[row]),
        "sensor": values,
        "sensor_valid": len(seen),
        "action": store.array("tick/action")[ahead],
        "action_valid": [tick + step < episode.ticks.stop for step in range(horizon)],
    }


class TestGather:
    @settings(max_examples=60, deadline=None)
    @given(data=st.data())
    def test_equals_a_loop_over_ticks(self, store, data):
        ticks = data.draw(st.lists(st.integers(0, store.ticks - 1), min_size=1, max_size=6))
        window = data.draw(st.integers(1, 40))
        horizon = data.draw(st.integers(1, 12))
        lag = data.draw(st.integers(0, 12))
        lag_s = data.draw(st.sampled_from([0.0, 0.013, 0.21, 5.0]))
        batch = store.gather(
            ticks, horizon, window, 7, feature_lag=lag, sensor_lag_s=lag_s, state_lag_s=lag_s
        )
        for index, tick in enumerate(ticks):
            for name, value in reference(store, tick, window, horizon, lag, lag_s).items():
                found = getattr(batch, name)[index].numpy()
                assert np.allclose(found, value, atol=1e-6), (name, tick)

    def test_fills_the_buffers_it_is_given_and_leaves_nothing_of_before(self, store):
        out = store.gather([100, 170], 8, 65, 20)
        pointers = out.sensor.data_ptr(), out.features.data_ptr()
        again = store.gather([0, 31], 8, 65, 20, out=out)
        assert again is out
        assert (out.sensor.data_ptr(), out.features.data_ptr()) == pointers
        fresh = store.gather([0, 31], 8, 65, 20)
        assert torch.equal(again.sensor, fresh.sensor)
        assert torch.equal(again.action, fresh.action)

    def test_refuses_foreign_ticks_and_buffers(self, store):
        with pytest.raises(IndexError, match="179"):
            store.gather([180])
        with pytest.raises(IndexError):
            store.gather([-1])
        with pytest.raises(ValueError, match="sensor_window"):
            store.gather([0], sensor_window=3, out=store.gather([0]))

    def test_an_absent_stream_has_no_width(self, tiny_store, tmp_path):
        path = tiny_store(tmp_path, sensor_channels=0)
        batch = FeatureStore.open(path).gather([0, 5], sensor_window=9)
        assert batch.sensor.shape == (2, 9, 0)
        assert batch.sensor_valid.tolist() == [0, 0]


class TestOpen:
    def test_writing_into_the_map_changes_nothing_on_disk(self, path):
        first = FeatureStore.open(path)
        before = first.array("tick/action").copy()
        first.array("tick/action")[:] = 7
        assert np.array_equal(FeatureStore.open(path).array("tick/action"), before)

    def test_survives_pickling(self, store):
        again = pickle.loads(pickle.dumps(store))
        assert np.array_equal(again.array("vl/key"), store.array("vl/key"))

    def test_many_chunks_are_one_flat_array(self, tiny_store, tmp_path, monkeypatch):
        monkeypatch.setattr("pipeline.store.schema.CHUNK_BYTES", 4096)
        path = tiny_store(tmp_path, episodes=40, readings_a_tick=12)
        store = FeatureStore.open(path)
        assert len(list((path / "sensor/values/c").iterdir())) == 4
        array = zarr.open_group(path, mode="r")["sensor/values"]
        assert np.array_equal(array[:], store.array("sensor/values"))
        batch = store.gather([store.ticks - 1], sensor_window=50)
        assert np.array_equal(batch.sensor[0].numpy(), array[-50:])

    def test_says_what_is_missing(self, tmp_path):
        with pytest.raises(StoreIncomplete, match=r"nowhere\.zarr.*stages\.extract"):
            FeatureStore.open(tmp_path / "nowhere.zarr")

    def test_names_a_truncated_and_a_missing_chunk(self, tiny_store, tmp_path):
        path = tiny_store(tmp_path)
        chunk = path / "vl/features/c/0/0/0"
        with chunk.open("r+b") as file:
            file.truncate(100)
        with pytest.raises(StoreIncomplete, match=r"vl/features/c/0/0/0.*found 100 bytes"):
            FeatureStore.open(path)
        chunk.unlink()
        with pytest.raises(StoreIncomplete, match="no file"):
            FeatureStore.open(path)

    def test_refuses_another_schema(self, tiny_store, tmp_path):
        path = tiny_store(tmp_path)
        zarr.open_group(path, mode="r+").attrs["schema"] = 99
        with pytest.raises(StoreMismatch, match="99"):
            FeatureStore.open(path)
