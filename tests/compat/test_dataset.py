"""Items are what the timeline and the store say, whichever door they come through."""

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from pipeline.base.config import Source
from pipeline.base.errors import ConfigError, RecordingError, StoreIncomplete, StoreMismatch
from pipeline.base.observation import Observation
from pipeline.datasets import (
    AsyncInsertionMeca500DatasetWithSensor,
    NewAsyncInsertionDataset,
    UnifiedBatch,
    UnifiedVLADataset,
    async_collate_fn_with_sensor,
    unified_collate_fn,
)
from pipeline.store import Batch, FeatureStore

STREAMS = (
    "feature_age",
    "sensor",
    "sensor_valid",
    "state",
    "state_valid",
    "action",
    "action_valid",
)


@pytest.fixture(scope="module")
def live(recordings: Path) -> UnifiedVLADataset:
    return UnifiedVLADataset(sources(recordings))


@pytest.fixture(scope="module")
def cached(recordings: Path, extracted: FeatureStore) -> UnifiedVLADataset:
    return UnifiedVLADataset(sources(recordings), store=extracted)


@pytest.fixture(scope="module")
def new(recordings: Path) -> UnifiedVLADataset:
    return UnifiedVLADataset(recordings / "new", "new")


def sources(recordings: Path) -> list[Source]:
    """The new ones first: the store has them last."""
    return [Source(name=name, path=str(recordings / name)) for name in ("new", "old")]


def equal(a: Any, b: Any) -> bool:
    """Whether two batches, or two samples, are the same."""
    if isinstance(a, UnifiedBatch):
        a, b = vars(a), vars(b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[name], b[name]) for name in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(equal, a, b))
    return np.array_equal(a, b) if isinstance(a, torch.Tensor | np.ndarray) else a == b


class TestItems:
    def test_frames_and_features_come_with_the_same_streams(self, live, cached):
        assert len(live) == len(cached) == len(live.ticks)
        items = list(range(0, len(live), 5))
        a, b = live.__getitems__(items), cached.__getitems__(items)
        for name in STREAMS:
            assert torch.equal(getattr(a, name), getattr(b, name)), name
        assert a.instruction == b.instruction
        assert a.features.shape == (len(items), 0, 0) and a.key is None and a.images is not None
        assert b.features.shape[1:] == cached.store.feature_shape and b.images is None
        rows = b.vl_row.numpy()
        assert np.array_equal(b.key.numpy(), cached.store.array("vl/key")[rows])

    def test_samples_make_the_batch_that_is_read_in_one_go(self, live, cached):
        for data in (live, cached):
            items = [0, 1, 2, len(data) - 1, 40]
            batch = unified_collate_fn(data.__getitems__(items))
            again = unified_collate_fn([data[item] for item in items])
            assert isinstance(batch, Batch) and isinstance(batch, Observation)
            assert equal(batch, again)
            assert equal(batch, unified_collate_fn([batch[i] for i in range(len(batch))]))
            with pytest.raises(IndexError):
                batch[len(items)]
        with pytest.raises(StoreMismatch, match="1 of its 2 samples"):
            unified_collate_fn([live[0], cached[0]])

    def test_a_row_is_decoded_once_for_the_ticks_that_share_it(self, live):
        batch = live.__getitems__([0, 1, 2, 3])
        assert batch.vl_row.tolist() == [0, 0, 0, 1]
        assert batch.images[0] is batch.images[2]
        assert batch.images[0] is not batch.images[3]
        moved = batch.to("meta")
        assert moved.sensor.is_meta and moved.tick.is_meta
        assert moved.images is batch.images and moved.instruction == batch.instruction

    def test_a_missing_view_is_absent_and_a_missing_stream_counts_nothing(self, copied):
        folder = copied("new")
        first = sorted((folder / "Red_point").iterdir())[0]
        for image in (first / "images" / "View2").iterdir():
            image.unlink()
        metadata = json.loads((first / "metadata.json").read_text())
        metadata |= {"camera_views": ["View1"], "sensor_windows_count": 0}
        (first / "metadata.json").write_text(json.dumps(metadata))
        (first / "sensor_data.npz").unlink()
        data = UnifiedVLADataset(folder)
        item, other = data[0], data[len(data) - 1]
        assert "View2" not in item["images"] and "View2" in other["images"]
        assert item["sensor_valid"] == 0 and other["sensor_valid"] == 65
        assert not item["sensor"].any() and item["sensor"].shape == (65, 1026)

    def test_views_and_windows_are_as_asked_for(self, recordings: Path) -> None:
        data = UnifiedVLADataset(
            recordings / "new", "new", 4, 2, 30, 20, 5.0, views=["View1"], instruction="go"
        )
        item = data[10]
        assert list(item["images"]) == ["View1"] and item["instruction"] == "go"
        assert item["action"].shape == (4, 7) and item["vl_row"] == 5
        assert item["sensor"].shape == (30, 1026) and item["state"].shape == (20, 12)
        assert float(data[1]["time"] - data[0]["time"]) == pytest.approx(0.2)


class TestOneActionRotation:
    def test_rotation_vectors_where_all_have_poses_else_euler_deltas(
        self, copied, recordings, live
    ):
        assert live.store.streams["action"]["names"][3:6] == ["rx", "ry", "rz"]
        old = copied("old")
        for states in old.glob("**/robot_states.npz"):
            states.unlink()
        data = UnifiedVLADataset([old, recordings / "new"])
        assert data.store.streams["action"]["names"][3:6] == ["da", "db", "dr"]
        with pytest.raises(StoreMismatch, match=r"action.*da.*rx|action.*rx.*da"):
            UnifiedVLADataset([old, recordings / "new"], action_rotation="rotvec")


class TestStore:
    def test_an_alias_takes_the_episodes_of_its_format(self, extracted, recordings):
        old = AsyncInsertionMeca500DatasetWithSensor(store=extracted)
        new = NewAsyncInsertionDataset(store=extracted.path)
        assert {episode.format for episode in old.episodes} == {"old"}
        assert {episode.format for episode in new.episodes} == {"new"}
        assert len(old) + len(new) == extracted.ticks
        assert async_collate_fn_with_sensor is unified_collate_fn
        again = NewAsyncInsertionDataset(recordings / "new", store=extracted)
        assert np.array_equal(again.ticks, new.ticks)
        assert [episode.source for episode in again.episodes] == ["new", "new"]

    def test_recordings_that_it_lacks_are_named(self, copied, extracted):
        folder = copied("new")
        episode = sorted((folder / "Red_point").iterdir())[0]
        episode.rename(episode.with_name("episode_20990101_000000"))
        with pytest.raises(StoreMismatch, match=r"episode_20990101_000000.*stages\.extract"):
            UnifiedVLADataset(folder, store=extracted)

    def test_settings_of_other_ticks_are_refused(self, extracted: FeatureStore) -> None:
        with pytest.raises(StoreMismatch, match=r"vlm_reuse_count: 5 .*found 3.*euler.*rotvec"):
            UnifiedVLADataset(store=extracted, vlm_reuse_count=5, action_rotation="euler_delta")
        with pytest.raises(StoreMismatch, match="'lerobot', found new, old"):
            UnifiedVLADataset(store=extracted, format="lerobot")


class TestErrors:
    def test_what_contradicts_itself(self, extracted: FeatureStore) -> None:
        with pytest.raises(ConfigError, match="recordings or a store"):
            UnifiedVLADataset()
        with pytest.raises(ConfigError, match="computed already"):
            UnifiedVLADataset(store=extracted, views=["View1"])

    def test_what_is_not_there(self, tmp_path: Path, recordings: Path) -> None:
        with pytest.raises(RecordingError, match="nowhere"):
            UnifiedVLADataset(tmp_path / "nowhere")
        with pytest.raises(RecordingError, match="old"):
            AsyncInsertionMeca500DatasetWithSensor(recordings / "new")
        with pytest.raises(StoreIncomplete, match=r"nowhere\.zarr"):
            UnifiedVLADataset(store=tmp_path / "nowhere.zarr")


class TestSplit:
    def test_whole_episodes_on_either_side_and_the_store_stays(self, cached):
        keys = cached.store.array("vl/key")
        before = keys.copy()
        train, held_out = cached.split(0.3)
        assert cached.store.array("vl/key") is keys and np.array_equal(keys, before)
        assert sorted(train.indices + held_out.indices) == list(range(len(cached)))
        sides = [set(cached.__getitems__(s.indices).episode.tolist()) for s in (train, held_out)]
        assert sides[0] and sides[1] and not sides[0] & sides[1]
        loader = DataLoader(held_out, batch_size=50, collate_fn=unified_collate_fn)
        assert len(next(iter(loader))) == min(50, len(held_out))


class TestWorkers:
    @pytest.mark.parametrize(
        ("start", "workers"), [("fork", 2), pytest.param("spawn", 1, marks=pytest.mark.slow)]
    )
    def test_batches_are_those_of_this_process(self, new, start, workers):
        loader = DataLoader(
            new,
            batch_sampler=[[0, 1, 5], [70, 40], [3]],
            num_workers=workers,
            collate_fn=unified_collate_fn,
            multiprocessing_context=start,
        )
        for batch, items in zip(loader, loader.batch_sampler, strict=True):
            assert equal(batch, new.__getitems__(items))

    def test_a_pickle_opens_the_data_again(self, live, cached):
        for data in (live, cached):
            sent = pickle.dumps(data)
            assert len(sent) < 4096
            assert equal(pickle.loads(sent)[3], data[3])
        alias = AsyncInsertionMeca500DatasetWithSensor(store=cached.store)
        again = pickle.loads(pickle.dumps(alias))
        assert type(again) is type(alias) and np.array_equal(again.ticks, alias.ticks)
