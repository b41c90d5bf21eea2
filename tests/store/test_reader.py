"""The reader agrees with plain zarr, and gathers what a loop over ticks would gather."""

import multiprocessing
import os
import pickle
import subprocess
import sys
import threading
from pathlib import Path

import dask.array
import numpy as np
import pytest
import torch
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.base.errors import StoreIncomplete
from pipeline.store import FeatureStore, episode_name, part_path, place
from pipeline.store.chunks import write_seal
from pipeline.store.schema import ARRAY_NAMES, ArraySpec, read_spec
from tests.conftest import write_tiny_store


@pytest.fixture(scope="module")
def path(tiny_store, tmp_path_factory) -> Path:
    return tiny_store(tmp_path_factory.mktemp("store"))


@pytest.fixture(scope="module")
def store(path) -> FeatureStore:
    return FeatureStore.open(path)


class TestPlainReaders:
    def test_zarr_dask_and_numpy_agree_with_the_map(self, path, store):
        for name in ARRAY_NAMES:
            mapped = store.array(name)
            array = zarr.open_array(path, path=name, mode="r")
            assert np.array_equal(array[:], mapped, equal_nan=True), name
            file = path / name / "c" / "/".join("0" * mapped.ndim)
            flat = np.fromfile(file, mapped.dtype, mapped.size).reshape(mapped.shape)
            assert np.array_equal(flat, mapped, equal_nan=True), name
            metadata = array.metadata.to_dict()
            assert [codec["name"] for codec in metadata["codecs"]] == ["bytes", "crc32c"]
            assert len(metadata["dimension_names"]) == len(metadata["shape"])
            rows = metadata["chunk_grid"]["configuration"]["chunk_shape"][0]
            assert (rows if name != "vl/features" else rows * mapped[:1].nbytes) % 4096 == 0
        lazy = dask.array.from_zarr(str(path), component="sensor/values")
        assert np.array_equal(lazy.compute(), store.array("sensor/values"))

    def test_a_store_of_schema_1_opens_with_its_larger_chunks(
        self, path, store, tmp_path, monkeypatch
    ):
        with monkeypatch.context() as earlier:
            earlier.setattr(ArraySpec, "row_multiple", 4096)
            earlier.setattr("tests.conftest.SCHEMA", 1)
            old = write_tiny_store(tmp_path)
        opened = FeatureStore.open(old)
        assert opened.attrs["schema"] == 1
        assert read_spec(old, "vl/features").chunk_rows == 4096
        assert read_spec(path, "vl/features").chunk_rows == 2048
        for name in ARRAY_NAMES:
            assert np.array_equal(opened.array(name), store.array(name), equal_nan=True), name

    def test_bfloat16_is_its_bits_with_an_attribute(self, tiny_store, tmp_path):
        path = tiny_store(tmp_path, dtype="bfloat16")
        array = zarr.open_array(path, path="vl/features", mode="r")
        assert array.dtype == np.uint16
        assert array.attrs["dtype"] == "bfloat16"
        gathered = FeatureStore.open(path).gather([0]).features
        bits = torch.from_numpy(array[:1].astype(np.int32) << 16).view(torch.float32)
        assert torch.equal(gathered.float(), bits)


def reference(
    store: FeatureStore,
    tick: int,
    window: int,
    horizon: int,
    lag: int,
    lag_s: float,
    window_s: float | None = None,
):
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
    if window_s is not None:
        seen = [reading for reading in seen if now - clock[reading] <= window_s + 1e-6]
    ages = np.zeros(window)
    if seen:
        ages[-len(seen) :] = now - clock[seen]
    values = np.zeros((window, store.sensor_channels), np.float32)
    if seen:
        values[-len(seen) :] = store.array("sensor/values")[seen]
    ahead = [min(tick + step, episode.ticks.stop - 1) for step in range(horizon)]
    return {
        "features": store.array("vl/features")[row],
        "feature_age": now - np.nanmax(store.array("vl/frame_time")[row]),
        "view_age": now - store.array("vl/frame_time")[row],
        "sensor": values,
        "sensor_age": ages,
        "sensor_valid": len(seen),
        "action": store.array("tick/action")[ahead],
        "action_valid": [tick + step < episode.ticks.stop for step in range(horizon)],
    }


class TestGather:
    @settings(max_examples=60)
    @given(data=st.data())
    def test_equals_a_loop_over_ticks(self, store, data):
        ticks = data.draw(st.lists(st.integers(0, store.ticks - 1), min_size=1, max_size=6))
        window = data.draw(st.integers(1, 40))
        horizon = data.draw(st.integers(1, 12))
        lag = data.draw(st.integers(0, 12))
        lag_s = data.draw(st.sampled_from([0.0, 0.013, 0.2, 0.5, 5.0]))
        window_s = data.draw(st.sampled_from([None, 1e-9, 0.05, 0.3, 9.0]))
        batch = store.gather(
            ticks,
            horizon,
            window,
            7,
            feature_lag=lag,
            sensor_lag_s=lag_s,
            state_lag_s=lag_s,
            sensor_window_s=window_s,
        )
        for index, tick in enumerate(ticks):
            wanted = reference(store, tick, window, horizon, lag, lag_s, window_s)
            for name, value in wanted.items():
                found = getattr(batch, name)[index].numpy()
                assert np.allclose(found, value, atol=1e-6, equal_nan=True), (name, tick)

    def test_a_lag_may_be_that_of_each_sample(self, store):
        ticks, rows, late_s = [20, 50, 100], np.array([0, 2, 9]), np.array([0.0, 0.1, 0.03])
        together = store.gather(ticks, feature_lag=rows, sensor_lag_s=late_s, state_lag_s=late_s)
        for index, tick in enumerate(ticks):
            lag_s = float(late_s[index])
            alone = store.gather([tick], 8, 65, 100, int(rows[index]), lag_s, lag_s)
            for name, value in vars(alone).items():
                found = getattr(together, name)[index]
                torch.testing.assert_close(found, value[0], rtol=0, atol=0, equal_nan=True)
        with pytest.raises(ValueError, match="a lag goes back in time"):
            store.gather(ticks, sensor_lag_s=-late_s)

    def test_the_age_of_a_feature_is_known_without_a_batch(self, store):
        ticks = np.array([0, 2, 31, 179])
        wanted = [reference(store, int(tick), 1, 1, 0, 0.0)["feature_age"] for tick in ticks]
        assert store.feature_age(ticks).tolist() == wanted

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


@pytest.fixture(scope="module", params=["float32", "bfloat16"])
def varied(tiny_store, tmp_path_factory, request) -> FeatureStore:
    """A row of six slots is three variants of two, some of them not valid."""
    path = tiny_store(tmp_path_factory.mktemp("varied"), slots=6, dtype=request.param)
    attrs = zarr.open_group(path, mode="r+").attrs
    spec = attrs.asdict()["feature_spec"]
    attrs["feature_spec"] = {**spec, "variants": 3}
    write_seal(path)
    store = FeatureStore.open(path)
    valid = store.array("vl/slot_valid")
    valid[:] = np.random.default_rng(1).integers(0, 2, valid.shape)
    return store


class TestVariants:
    @settings(max_examples=60)
    @given(data=st.data())
    def test_each_tick_sees_the_variant_it_asks_for(self, varied, data):
        ticks = data.draw(st.lists(st.integers(0, varied.ticks - 1), max_size=9))
        lag = data.draw(st.integers(0, 12))
        asked = data.draw(
            st.none()
            | st.lists(st.integers(0, 2), min_size=len(ticks), max_size=len(ticks)).map(np.array)
        )
        if asked is not None:
            asked = asked.astype(np.int64)
        batch = varied.gather(ticks, feature_lag=lag, variants=asked)
        plain = varied.gather(ticks, feature_lag=lag)
        for name in vars(plain).keys() - {"features", "slot_valid"}:
            assert torch.equal(getattr(batch, name), getattr(plain, name))
        both = varied.gather(ticks, feature_lag=lag, variants=asked, feature_history=2)
        older = varied.gather(ticks, feature_lag=lag + 1, variants=asked)
        assert torch.equal(both.features, torch.cat([batch.features, older.features], dim=1))
        assert torch.equal(both.slot_valid, torch.cat([batch.slot_valid, older.slot_valid], dim=1))
        assert torch.equal(both.feature_age, batch.feature_age)
        assert varied.feature_shape == batch.features.shape[1:] == (2, 8)
        stored = varied.array("vl/features")
        if stored.dtype == np.uint16:
            stored = (stored.astype(np.uint32) << 16).view(np.float32)
        for index, tick in enumerate(ticks):
            episode = next(one for one in varied.episodes if tick in one.ticks)
            row = max(int(varied.array("tick/vl_row")[tick]) - lag, episode.vl_rows.start)
            first = 0 if asked is None else 2 * asked[index]
            slots = slice(first, first + 2)
            assert np.array_equal(batch.features[index].float().numpy(), stored[row, slots])
            valid = varied.array("vl/slot_valid")[row, slots]
            assert np.array_equal(batch.slot_valid[index].numpy(), valid)

    def test_refuses_a_variant_that_is_not_there(self, varied, store):
        for wrong in ([0, 3], [0, -1], [0]):
            with pytest.raises(ValueError, match=r"a variant in 0\.\.2 .*vlm\.variants"):
                varied.gather([0, 1], variants=np.array(wrong))
        with pytest.raises(ValueError, match=r"a variant in 0\.\.0"):
            store.gather([0], variants=np.array([1]))


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

    def test_refuses_what_is_no_whole_store(self, tiny_store, tmp_path):
        with pytest.raises(StoreIncomplete, match=r"nowhere\.zarr.*stages\.extract"):
            FeatureStore.open(tmp_path / "nowhere.zarr")
        path = tiny_store(tmp_path)
        build = path.rename(part_path(path))
        with pytest.raises(StoreIncomplete, match="only the unfinished build") as refused:
            FeatureStore.open(build)
        assert f"extract.store={path}." in str(refused.value)
        build.rename(path)
        os.truncate(path / "vl/features/c/0/0/0", 100)
        with pytest.raises(StoreIncomplete, match=r"vl/features/c/0/0/0.*found 100\."):
            FeatureStore.open(path)

    def test_a_row_is_named_by_its_episode_and_time(self, store):
        assert episode_name(store.episodes[1]) == "right/episode_001"
        for stream, row, name in (
            ("tick", 30, "right/episode_001, tick 0 (at 0.000 s)"),
            ("tick", 29, "left/episode_000, tick 29 (at 2.900 s)"),
            ("vl", 59, "right/episode_005, VL row 9 (at 2.700 s)"),
            ("sensor", 8, "left/episode_000, sensor reading 8 (at 0.100 s)"),
        ):
            assert place(store, stream, row) == name


def gathered(store: FeatureStore, ticks: list[int], answers) -> None:
    """What a worker process does."""
    batch = store.gather(ticks, sensor_window=9)
    answers.put({name: value.numpy().tobytes() for name, value in vars(batch).items()})


class TestProcesses:
    @pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
    def test_workers_gather_what_their_parent_gathers(self, path, method):
        store = FeatureStore.open(path)
        store.gather([0])
        store.warm()
        context = multiprocessing.get_context(method)
        answers = context.Queue()
        worker = context.Process(target=gathered, args=(store, [0, 7, 100], answers))
        worker.start()
        found = answers.get(timeout=60)
        worker.join()
        assert worker.exitcode == 0
        batch = store.gather([0, 7, 100], sensor_window=9)
        assert found == {name: value.numpy().tobytes() for name, value in vars(batch).items()}

    def test_a_fork_does_not_wait_for_threads_that_it_does_not_have(self, path):
        program = f"""
import os, signal, sys
import numpy as np, torch
from pipeline.store import FeatureStore
torch.set_num_threads(2)
store = FeatureStore.open({str(path)!r})
ticks = np.tile(np.arange(store.ticks), 20)
expected = store.gather(ticks).sensor  # large enough for all threads
if os.fork() == 0:
    signal.alarm(20)
    os._exit(0 if torch.equal(store.gather(ticks).sensor, expected) else 3)
sys.exit(os.waitstatus_to_exitcode(os.wait()[1]))
"""
        environment = {**os.environ, "OMP_NUM_THREADS": "2"}
        subprocess.run([sys.executable, "-c", program], check=True, env=environment, timeout=60)


@pytest.fixture
def asked(monkeypatch) -> list[tuple[tuple[int, ...], list[int], int]]:
    """The rows that are asked for where no map fits in memory: shape of the array, first, count."""
    rows_asked = []
    monkeypatch.setattr("pipeline.store.gather.available_bytes", lambda: 0)
    monkeypatch.setattr(
        "pipeline.store.gather.will_need",
        lambda array, first, rows: rows_asked.append((array.shape, first.tolist(), rows)),
    )
    return rows_asked


class TestMemory:
    def test_a_store_larger_than_memory_gives_the_same(self, path, store, asked):
        expected = store.gather([31, 95], horizon=2, sensor_window=9, state_window=5)
        asked.clear()
        large = FeatureStore.open(path)
        batch = large.gather([31, 95], horizon=2, sensor_window=9, state_window=5)
        for name, value in vars(expected).items():
            assert torch.equal(getattr(batch, name), value)
        ends = store.array("tick/sensor_end")[[31, 95]]
        assert (store.array("sensor/values").shape, (ends - 9).tolist(), 9) in asked
        rows = store.array("tick/vl_row")[[31, 95]].tolist()
        assert (store.array("vl/features").shape, rows, 1) in asked
        assert len(asked) == 4

    def test_rows_of_variants_are_asked_for_by_their_row(self, varied, asked):
        large = FeatureStore.open(varied.path)
        large.gather([30, 60], variants=np.array([2, 1]))
        rows = varied.array("tick/vl_row")[[30, 60]].tolist()
        assert (varied.array("vl/features").shape, rows, 1) in asked

    def test_what_fits_is_read_once_in_the_background(self, path, monkeypatch):
        read = []
        monkeypatch.setattr("pipeline.store.gather.populate", lambda array: read.append(array))
        store = FeatureStore.open(path)
        for _ in range(2):
            store.warm()
        for thread in threading.enumerate():
            if thread.name == "warm":
                thread.join()
        names = ("tick/action", "vl/features", "state/values", "sensor/values")
        assert {id(array) for array in read} == {id(store.array(name)) for name in names}
        assert len(read) == 4
