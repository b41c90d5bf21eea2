"""Which way batches are made, what is said of it, and what an archive becomes."""

import multiprocessing
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.base.errors import ConfigError, DiskFull, StoreIncomplete, StoreMismatch
from pipeline.store import FeatureStore
from pipeline.store.archive import archive
from pipeline.store.schema import ARRAY_NAMES
from pipeline.train.batches import choose_feed, open_store

CPU, CUDA = torch.device("cpu"), torch.device("cuda")
ALL = {"features", "sensor", "state", "action"}


@pytest.fixture(scope="module")
def path(tiny_store: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_store(tmp_path_factory.mktemp("choice"))


@pytest.fixture(scope="module")
def store(path: Path) -> FeatureStore:
    return FeatureStore.open(path)


@pytest.fixture(scope="module")
def archived(path: Path) -> Path:
    output = path.with_name("tiny.archive.zarr")
    archive(path, output, level=1, threads=1)
    return output


class TestChoice:
    def test_auto_on_the_cpu_is_the_map(self, store: FeatureStore) -> None:
        chosen = choose_feed("auto", store, CPU)
        assert (chosen.feed, chosen.on_device) == ("mapped", frozenset())
        assert chosen.why == "feed: mapped (auto: training runs on the cpu)"

    def test_auto_takes_a_gpu_that_has_room_for_all(self, store: FeatureStore) -> None:
        chosen = choose_feed("auto", store, CUDA, free=2**30)
        assert (chosen.feed, chosen.on_device) == ("device", ALL)
        assert "auto" in chosen.why and "free on cuda" in chosen.why

    def test_auto_leaves_a_gpu_that_has_not(self, store: FeatureStore) -> None:
        largest = store.array("sensor/values").nbytes
        chosen = choose_feed("auto", store, CUDA, free=largest)
        assert (chosen.feed, chosen.on_device) == ("mapped", frozenset())

    def test_device_takes_what_fits_the_smallest_first(self, store: FeatureStore) -> None:
        sizes = {name: store.tensor(name).nbytes for name in ALL}
        largest = max(sizes, key=lambda name: sizes[name])
        free = int((sum(sizes.values()) - 1) / 0.6)
        assert choose_feed("device", store, CPU, free).on_device == ALL - {largest}
        assert choose_feed("device", store, CPU, 0).on_device == frozenset()
        assert choose_feed("device", store, CPU).on_device == ALL

    def test_a_stream_that_is_not_there_needs_no_room(
        self, tiny_store: Callable[..., Path], tmp_path: Path
    ) -> None:
        lacking = FeatureStore.open(tiny_store(tmp_path, sensor_channels=0))
        assert choose_feed("device", lacking, CPU).on_device == ALL - {"sensor"}

    def test_what_is_asked_for_is_said(self, store: FeatureStore) -> None:
        for feed in ("mapped", "device"):
            chosen = choose_feed(feed, store, CPU)
            assert chosen.feed == feed
            assert chosen.why.startswith(f"feed: {feed}")
            assert "train_head.feed" in chosen.why


class TestArchive:
    @pytest.mark.parametrize("feed", ["auto", "compressed"])
    def test_is_restored_once_to_scratch(
        self, store: FeatureStore, archived: Path, tmp_path: Path, feed: str
    ) -> None:
        said: list[str] = []
        found = open_store(archived, feed, tmp_path, said.append)
        assert found.path.parent == tmp_path
        assert "restoring" in said[0] and str(archived) in said[0]
        for name in ARRAY_NAMES:
            assert found.array(name).tobytes() == store.array(name).tobytes()
        written = (found.path / "zarr.json").stat().st_mtime_ns
        again = open_store(archived, feed, tmp_path, said.append)
        assert again.path == found.path
        assert (again.path / "zarr.json").stat().st_mtime_ns == written
        assert len(said) == 2 and "still in" in said[1]

    def test_another_content_is_another_store(
        self, tiny_store: Callable[..., Path], archived: Path, tmp_path: Path
    ) -> None:
        first = open_store(archived, "auto", tmp_path, print).path
        other = tmp_path / "other" / archived.name
        archive(tiny_store(tmp_path, seed=1), other, level=1, threads=1)
        assert open_store(other, "auto", tmp_path, print).path != first

    def test_the_same_content_is_the_same_store(
        self, path: Path, archived: Path, tmp_path: Path
    ) -> None:
        smaller = tmp_path / "copies" / archived.name
        archive(path, smaller, level=9, threads=1)
        first = open_store(archived, "auto", tmp_path, print).path
        assert open_store(smaller, "auto", tmp_path, print).path == first

    def test_processes_that_ask_at_a_time_restore_it_once(
        self, archived: Path, tmp_path: Path
    ) -> None:
        context = multiprocessing.get_context("fork")
        said = context.SimpleQueue()
        asking = [
            context.Process(target=open_store, args=(archived, "auto", tmp_path, said.put))
            for _ in range(3)
        ]
        for process in asking:
            process.start()
        for process in asking:
            process.join()
        assert [process.exitcode for process in asking] == [0, 0, 0]
        lines = [said.get() for _ in asking]
        assert sum("restoring" in line for line in lines) == 1

    def test_too_little_room_is_said_before_anything_is_written(
        self, archived: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("pipeline.train.batches.scratch.free_bytes", lambda folder: 2**20)
        with pytest.raises(DiskFull, match=r"expected 6\d\.\d MiB.*found 1\.0 MiB free.*scratch"):
            open_store(archived, "auto", tmp_path, print)
        assert not [*tmp_path.glob("*.zarr")]

    def test_a_damaged_one_leaves_nothing(self, archived: Path, tmp_path: Path) -> None:
        broken = tmp_path / "broken.archive.zarr"
        shutil.copytree(archived, broken)
        shard = next(file for file in (broken / "sensor/values/c").rglob("*") if file.is_file())
        content = bytearray(shard.read_bytes())
        content[len(content) // 3] ^= 1
        shard.write_bytes(content)
        with pytest.raises(StoreIncomplete, match="sensor/values"):
            open_store(broken, "auto", tmp_path / "scratch", print)
        assert not [*(tmp_path / "scratch").glob("*.zarr")]

    def test_feeds_that_do_not_fit_are_refused(
        self, path: Path, archived: Path, tmp_path: Path
    ) -> None:
        for feed in ("mapped", "device"):
            with pytest.raises(ConfigError, match=r"is an archive.*train_head\.feed=auto"):
                open_store(archived, feed, tmp_path, print)
        with pytest.raises(ConfigError, match=r"is none.*stages\.archive"):
            open_store(path, "compressed", tmp_path, print)
        with pytest.raises(StoreIncomplete, match=r"stages\.extract"):
            open_store(tmp_path / "nowhere.zarr", "compressed", tmp_path, print)

    def test_opening_one_as_a_store_says_what_to_do(self, archived: Path) -> None:
        with pytest.raises(StoreMismatch, match=r"found an archive.*stages\.archive --restore"):
            FeatureStore.open(archived)

    def test_a_store_is_opened_where_it_lies(self, path: Path, tmp_path: Path) -> None:
        said: list[str] = []
        found = open_store(path, "auto", tmp_path, said.append)
        assert found.path == path
        assert np.array_equal(found.gather([3]).action, FeatureStore.open(path).gather([3]).action)
        assert said == [] and not [*tmp_path.iterdir()]
