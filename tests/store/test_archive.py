"""An archive gives the store back to the byte, or names the file that was changed."""

import json
import os
import random
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import dask.array
import numpy as np
import pytest
import zarr

import pipeline.store.archive as archives
from pipeline.base.errors import DiskFull, StoreIncomplete, StoreLocked, StoreMismatch
from pipeline.store import FeatureStore, Sizes, StoreBuild, arrays, build_lock, part_path, schema
from pipeline.store.archive import archive, is_archive, restore
from pipeline.store.schema import INCREMENTAL, read_specs
from tests.store.samples import TEXT, attributes_of, content, edit, flip, index_of, put

SIZES = Sizes(
    episode=2,
    tick=500,
    vl_row=10_000,
    sensor_reading=21_000,
    state_reading=9_000,
    byte=2 * len(TEXT),
    slot=2,
    dim=6,
    view=2,
    action_dim=3,
    channel=7,
    state_dim=5,
)


def write_store(
    folder: Path, features: str = "float32", sensor: str = "float32", **sizes: int
) -> Path:
    """A finished store of random bytes: NaN with payloads, infinities and -0.0 among them."""
    specs = arrays(Sizes(**{**vars(SIZES), **sizes}), features, sensor)
    rng = np.random.default_rng(0)
    build = StoreBuild(folder / "s.zarr", specs, plan="plan")
    build.create()
    build.allocate()
    index = index_of(specs)
    for name, spec in specs.items():
        if name not in INCREMENTAL:
            build.write(name, 0, index[name] if name in index else random_rows(rng, spec))
    build.finish_layout(attributes_of(specs), {"slots": ["mean", "grid"]})
    rows = random_rows(rng, specs["vl/features"])
    keys = [rng.bytes(16) for _ in rows]
    build.commit(range(len(rows)), rows, keys, build.environment_index({"torch": "2"}))
    build.seal()
    return build.target


def random_rows(rng: np.random.Generator, spec) -> np.ndarray:
    """A third zero, a third small numbers, a third any bits."""
    rows = np.frombuffer(rng.bytes(spec.data_bytes), spec.dtype).reshape(spec.shape).copy()
    third = len(rows) // 3
    rows[:third] = 0
    rows[third : 2 * third] = rng.integers(0, 9, rows[third : 2 * third].shape)
    if rows.size and spec.dtype.kind == "f":
        rows[0] = -0.0
    return rows


@pytest.fixture(scope="module")
def in_small_pieces() -> Iterator[None]:
    """Chunk files, shards and inner chunks so small that a small store has several of each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.store.schema.CHUNK_BYTES", 2**17)
        patch.setattr("pipeline.store.archive.SHARD_BYTES", 2**18)
        patch.setattr("pipeline.store.archive.INNER_BYTES", 2**14)
        yield


@pytest.fixture(scope="module")
def originals(tmp_path_factory, in_small_pieces) -> Path:
    """A folder with a store and its archive."""
    folder = tmp_path_factory.mktemp("originals")
    archive(write_store(folder), folder / "s.archive.zarr", level=1, threads=2)
    return folder


@pytest.fixture
def archived(tmp_path, originals) -> tuple[Path, Path]:
    """A copy of the store and of its archive."""
    names = "s.zarr", "s.archive.zarr"
    store, output = (shutil.copytree(originals / name, tmp_path / name) for name in names)
    return store, output


@pytest.mark.usefixtures("in_small_pieces")
@pytest.mark.parametrize(
    ("features", "sensor", "sizes"),
    [
        ("float32", "float32", {}),
        ("float16", "float16", {"slot": 6}),
        ("bfloat16", "float32", {"sensor_reading": 0}),
        ("float32", "float32", {"sensor_reading": 0, "channel": 0}),
    ],
)
def test_every_byte_of_every_file_comes_back(tmp_path, features, sensor, sizes):
    store = write_store(tmp_path, features, sensor, **sizes)
    output, back = tmp_path / "s.archive.zarr", tmp_path / "back.zarr"
    before = content(store)
    raw = archive(store, output, level=1, threads=2)
    restore(output, back, threads=2)
    assert content(back) == before == content(store)
    assert not part_path(output).exists()
    assert raw == sum(spec.data_bytes for spec in read_specs(store).values())


class TestArchive:
    def test_plain_zarr_and_dask_read_it(self, originals):
        store, output = originals / "s.zarr", originals / "s.archive.zarr"
        ours, theirs = zarr.open_group(output, mode="r"), zarr.open_group(store, mode="r")
        for name, spec in read_specs(store).items():
            array = ours[name]
            assert array[...].tobytes() == theirs[name][...].tobytes()
            assert array.metadata.dimension_names == spec.dimensions
            assert array.attrs.asdict() == theirs[name].attrs.asdict()
        part = dask.array.from_zarr(str(output), component="sensor/values")[9000:9100, 2]
        assert part.compute().tobytes() == theirs["sensor/values"][9000:9100, 2].tobytes()
        assert ours.attrs["streams"] == theirs.attrs["streams"]
        assert ours["vl"].attrs["slots"] == ["mean", "grid"]
        array = zarr.open_array(output, path="sensor/values", mode="r")
        assert array.nchunks > array._nshards > 1
        codecs = json.dumps(array.metadata.to_dict()["codecs"], default=str)
        assert codecs.count("crc32c") == 2, "one for an inner chunk, one for the shard's index"

    def test_only_an_archive_is_one(self, originals, tmp_path):
        store, output = originals / "s.zarr", originals / "s.archive.zarr"
        assert is_archive(output)
        assert not is_archive(store)
        assert not is_archive(tmp_path / "nothing")
        with pytest.raises(StoreMismatch, match=r"found an archive.*stages\.archive --restore"):
            FeatureStore.open(output)
        for other in (store, tmp_path / "nothing"):
            with pytest.raises(StoreMismatch, match="expected an archive, found no"):
                restore(other, tmp_path / "back.zarr", threads=2)

    def test_the_same_store_again_is_nothing_to_do_and_another_is_refused(self, archived, tmp_path):
        store, output = archived
        before = content(output)
        assert archive(store, output, level=9, threads=1) is None
        put(store, "tick/action", 0, 9.0)
        with pytest.raises(StoreMismatch, match=rf"not an archive of {store}.*archive.output"):
            archive(store, output, level=1, threads=1)
        assert content(output) == before

    def test_one_at_a_time(self, originals, tmp_path):
        output, target = tmp_path / "second.zarr", tmp_path / "back.zarr"
        with build_lock(output), pytest.raises(StoreLocked, match=f"process {os.getpid()}"):
            archive(originals / "s.zarr", output, level=1, threads=1)
        with build_lock(target), pytest.raises(StoreLocked):
            restore(originals / "s.archive.zarr", target, threads=2)


@pytest.mark.parametrize(
    ("harm", "match"),
    [
        (
            lambda store: flip(store / "sensor/values/c/2/0", 1000),
            r"sensor/values/c/2/0: expected the crc32c .*stages\.verify",
        ),
        (shutil.rmtree, r"Run python -m stages\.extract"),
    ],
)
def test_a_damaged_store_is_not_archived(archived, tmp_path, harm, match):
    harm(archived[0])
    output = tmp_path / "damaged.archive.zarr"
    with pytest.raises(StoreIncomplete, match=match):
        archive(archived[0], output, level=1, threads=2)
    assert not list(tmp_path.glob("damaged*/"))


SHARD = "sensor/values/c/1/0"
DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "index": (lambda a: flip(a / SHARD, -9, 4), rf"{SHARD}: .*sensor/values cannot be read"),
    "short": (lambda a: os.truncate(a / SHARD, 99), rf"{SHARD}: .*sensor/values cannot be read"),
    "missing": (lambda a: (a / SHARD).unlink(), "archive is damaged: .*sensor/values"),
    "another shard": (
        lambda a: shutil.copy(a / "vl/features/c/1/0/0", a / "vl/features/c/0/0/0"),
        "archive is damaged: .*vl/features",
    ),
}


class TestDamagedArchive:
    @pytest.mark.parametrize(("damage", "match"), DAMAGES.values(), ids=DAMAGES)
    def test_is_named_and_restores_nothing(self, archived, tmp_path, damage, match):
        damage(archived[1])
        with pytest.raises(StoreIncomplete, match=f"(?s){match}"):
            restore(archived[1], tmp_path / "back.zarr", threads=2)
        assert not list(tmp_path.glob("back.zarr*/"))

    def test_any_flipped_bit_of_any_shard(self, archived, tmp_path):
        chance = random.Random(0)
        shards = sorted(path for path in archived[1].rglob("c/**/*") if path.is_file())
        path = chance.choice(shards)
        flip(path, chance.randrange(path.stat().st_size), 4)
        with pytest.raises(StoreIncomplete, match=str(path)):
            restore(archived[1], tmp_path / "back.zarr", threads=2)


class TestRestore:
    def test_an_equal_store_is_left_as_it_is(self, archived):
        store, output = archived
        inode = store.stat().st_ino
        restore(output, store, threads=2)
        assert store.stat().st_ino == inode

    @pytest.mark.parametrize(
        "change",
        [
            lambda store: edit(store / "zarr.json", lambda it: it["attributes"].update(note="")),
            lambda store: flip(store / "tick/action/c/0/0", 9),
        ],
    )
    def test_another_store_is_not_written_over(self, archived, change):
        store, output = archived
        change(store)
        before = content(store)
        match = r"not the archived store.*archive\.store|tick/action/c/0/0: "
        with pytest.raises((StoreMismatch, StoreIncomplete), match=match):
            restore(output, store, threads=2)
        assert content(store) == before

    def test_an_unfinished_extraction_is_kept(self, archived):
        """Even one of the same plan: the archive may turn out to be damaged."""
        store, output = archived
        build = StoreBuild(store, read_specs(store), "plan")
        shutil.rmtree(store)
        build.create()
        build.finish_layout(attributes_of(build.specs), {})
        with pytest.raises(StoreMismatch, match=r"s\.zarr\.part: .* unfinished build"):
            restore(output, store, threads=2)
        assert build.part.exists()


def test_a_full_disk_keeps_nothing_of_what_was_begun(originals, small_disk):
    (small_disk / "ballast").write_bytes(bytes(8 * 2**20 - 2**17))
    folder = small_disk / "here"
    folder.mkdir()
    with pytest.raises(DiskFull, match=r"a\.zarr: no space left.*make room"):
        archive(originals / "s.zarr", folder / "a.zarr", level=1, threads=2)
    with pytest.raises(DiskFull, match=r"back\.zarr.*no space left.*make room"):
        restore(originals / "s.archive.zarr", folder / "back.zarr", threads=2)
    assert sorted(os.listdir(folder)) == ["a.zarr.lock", "back.zarr.lock"]


def work_slowly(what: str, source: Path, target: Path) -> None:
    """Archive or restore, slowly enough to be killed midway."""
    real = archives._read_shard

    def slow(*arguments: Any) -> Any:
        time.sleep(0.02)
        return real(*arguments)

    schema.CHUNK_BYTES, archives.SHARD_BYTES, archives.INNER_BYTES = 2**17, 2**18, 2**14
    archives._read_shard = slow
    if what == "archive":
        archive(source, target, 1, 2)
    else:
        restore(source, target, 2)


@pytest.mark.parametrize("what", ["archive", "restore"])
@pytest.mark.parametrize(
    ("kills", "seed"), [(1, 0), *(pytest.param(6, n, marks=pytest.mark.slow) for n in range(1, 4))]
)
def test_kills_at_random_instants_end_in_the_whole(
    originals, fork_server, tmp_path, what, kills, seed
):
    chance = random.Random(seed)
    store, output = originals / "s.zarr", originals / "s.archive.zarr"
    source = store if what == "archive" else output
    target = tmp_path / "target.zarr"
    hits = 0
    for _ in range(kills):
        process = fork_server.Process(target=work_slowly, args=(what, source, target))
        process.start()
        while process.is_alive() and not part_path(target).exists():
            time.sleep(0.002)
        time.sleep(chance.uniform(0.0, 0.4))
        hits += process.is_alive()
        assert not target.exists()
        process.kill()
        process.join()
        assert not is_archive(part_path(target)), "only a complete archive has a manifest"
    assert hits == kills, "the kills came too late to test anything"
    if what == "archive":
        archive(store, target, level=1, threads=2)
        output, target = target, tmp_path / "back.zarr"
    restore(output, target, threads=2)
    assert content(target) == content(store)
    assert not list(tmp_path.glob("*.part"))
