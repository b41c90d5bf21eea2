"""An archive gives back the store to the byte, or says which file is not as it was."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import dask.array
import google_crc32c
import numpy as np
import pytest
import zarr

from pipeline.base.errors import ConfigError, DiskFull, StoreIncomplete, StoreLocked, StoreMismatch
from pipeline.store import FeatureStore, Sizes, StoreBuild, arrays, build_lock, part_path
from pipeline.store.archive import archive, codec_for, is_archive, restore
from pipeline.store.chunks import write_seal
from pipeline.store.schema import INCREMENTAL, read_specs
from tests.store.samples import TEXT, attributes_of, index_of

DEMO = Path(__file__).resolve().parents[2] / "cache_store/demo.zarr"
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
SHAPES = {
    "all streams": {},
    "no sensor": {"sensor_reading": 0, "channel": 0},
    "a sensor without readings": {"sensor_reading": 0},
    "no state": {"state_reading": 0, "state_dim": 0},
    "variants": {"slot": 6},
}


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
            values = index[name] if name in index else random_rows(rng, spec)
            build.write(name, 0, values)
    build.finish_layout(attributes_of(specs), {"slots": ["mean", "grid"]})
    rows = random_rows(rng, specs["vl/features"])
    count = len(rows)
    number = build.environment_index({"torch": "2"})
    build.commit(range(count), rows, [rng.bytes(16) for _ in range(count)], number)
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


def content(root: Path) -> dict[str, bytes]:
    """Every file below a folder."""
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in root.rglob("*")
        if path.is_file()
    }


def flip(path: Path, offset: int) -> None:
    data = bytearray(path.read_bytes())
    data[offset] ^= 0x10
    path.write_bytes(data)


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
    """A store and its archive, to do anything to."""
    names = "s.zarr", "s.archive.zarr"
    store, output = (shutil.copytree(originals / name, tmp_path / name) for name in names)
    return store, output


@pytest.mark.usefixtures("in_small_pieces")
class TestRoundTrip:
    @pytest.mark.parametrize(
        ("features", "sensor"),
        [("float32", "float32"), ("float16", "float16"), ("bfloat16", "float32")],
    )
    def test_every_byte_of_every_file_comes_back(self, tmp_path, features, sensor):
        self.check(tmp_path, write_store(tmp_path, features, sensor))

    @pytest.mark.parametrize("sizes", SHAPES.values(), ids=SHAPES)
    def test_whatever_streams_there_are(self, tmp_path, sizes):
        self.check(tmp_path, write_store(tmp_path, **sizes))

    def check(self, folder: Path, store: Path) -> None:
        output, back = folder / "s.archive.zarr", folder / "back.zarr"
        before = content(store)
        manifest = archive(store, output, level=1, threads=2)
        restore(output, back, threads=2)
        assert content(back) == before == content(store)
        assert not part_path(output).exists()
        assert manifest is not None
        assert manifest.raw_bytes == sum(spec.data_bytes for spec in read_specs(store).values())
        shards = [path for path in output.rglob("c/**/*") if path.is_file()]
        assert manifest.stored_bytes == sum(path.stat().st_size for path in shards)
        assert manifest.stored_bytes < manifest.raw_bytes
        assert FeatureStore.open(back).ticks == FeatureStore.open(store).ticks


def test_chunks_of_the_real_sizes(tiny_store, tmp_path):
    store, back = tiny_store(tmp_path), tmp_path / "back.zarr"
    archive(store, tmp_path / "a.zarr", level=5, threads=2)
    restore(tmp_path / "a.zarr", back, threads=2)
    assert content(back) == content(store)


@pytest.mark.slow
def test_the_demos_store(tmp_path):
    if not DEMO.is_dir():
        pytest.skip("no demo store: run dvc repro")
    manifest = archive(DEMO, tmp_path / "a.zarr", level=5, threads=2)
    restore(tmp_path / "a.zarr", tmp_path / "back.zarr", threads=2)
    assert subprocess.run(["diff", "-r", DEMO, tmp_path / "back.zarr"]).returncode == 0
    assert manifest is not None
    assert manifest.raw_bytes > 5 * manifest.stored_bytes


class TestArchive:
    def test_plain_zarr_and_dask_read_it(self, archived):
        store, output = archived
        ours, theirs = zarr.open_group(output, mode="r"), zarr.open_group(store, mode="r")
        for name, spec in read_specs(store).items():
            found = ours[name]
            assert found[...].tobytes() == theirs[name][...].tobytes()
            assert found.metadata.dimension_names == spec.dimensions
            assert found.attrs.asdict() == theirs[name].attrs.asdict()
        part = dask.array.from_zarr(str(output), component="sensor/values")[9000:9100, 2]
        assert part.compute().tobytes() == theirs["sensor/values"][9000:9100, 2].tobytes()
        assert ours.attrs["streams"] == theirs.attrs["streams"]
        assert ours["vl"].attrs["slots"] == ["mean", "grid"]

    def test_several_shards_of_checksummed_inner_chunks(self, archived):
        _, output = archived
        array = zarr.open_array(output, path="sensor/values", mode="r")
        assert array.nchunks > array._nshards > 1
        codecs = json.dumps(array.metadata.to_dict()["codecs"], default=str)
        assert codecs.count("crc32c") == 2, "one for an inner chunk, one for the shard's index"

    def test_only_an_archive_is_one(self, archived, tmp_path):
        store, output = archived
        assert is_archive(output)
        assert not is_archive(store)
        assert not is_archive(tmp_path / "nothing")
        with pytest.raises(StoreMismatch, match=r"found an archive.*stages\.archive --restore"):
            FeatureStore.open(output)

    def test_the_same_store_again_is_nothing_to_do(self, archived):
        store, output = archived
        before = content(output)
        assert archive(store, output, level=9, threads=1) is None
        assert content(output) == before

    def test_another_archive_is_not_written_over(self, archived, tmp_path):
        _, output = archived
        (tmp_path / "other").mkdir()
        other = write_store(tmp_path / "other", slot=1)
        before = content(output)
        with pytest.raises(StoreMismatch, match=r"not an archive of .*other.*archive.output"):
            archive(other, output, level=1, threads=1)
        assert content(output) == before

    def test_one_at_a_time(self, archived, tmp_path):
        output = tmp_path / "second.zarr"
        with build_lock(output), pytest.raises(StoreLocked, match=f"process {os.getpid()}"):
            archive(archived[0], output, level=1, threads=1)

    def test_a_disk_that_does_not_keep_what_was_written(self, archived, tmp_path, monkeypatch):
        def rot(path: Path) -> None:
            flip(path, 500)

        monkeypatch.setattr("pipeline.store.archive.sync", rot)
        with pytest.raises(StoreIncomplete, match=r"second\.zarr\.part/vl/features/c/\d/0/0: "):
            archive(archived[0], tmp_path / "second.zarr", level=1, threads=1)
        assert not list(tmp_path.glob("second.zarr*/"))

    def test_stopped_it_leaves_nothing(self, archived, tmp_path, monkeypatch):
        def stop(*arguments):
            raise KeyboardInterrupt

        monkeypatch.setattr("pipeline.store.archive.codec_for", stop)
        with pytest.raises(KeyboardInterrupt):
            archive(archived[0], tmp_path / "second.zarr", level=1, threads=1)
        assert not list(tmp_path.glob("second.zarr*/"))

    def test_from_and_to_a_disk_that_cannot_be_written(self, originals, small_disk, tmp_path):
        store, output = (
            shutil.copytree(originals / name, small_disk / name)
            for name in ("s.zarr", "s.archive.zarr")
        )
        subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
        archive(store, tmp_path / "a.zarr", level=1, threads=2)
        restore(output, tmp_path / "back.zarr", threads=2)
        assert content(tmp_path / "back.zarr") == content(store)

    def test_a_store_replaced_meanwhile_is_noticed(self, archived, tmp_path, monkeypatch):
        store, _ = archived

        def replacing(*arguments):
            if not (tmp_path / "moved").exists():
                store.rename(tmp_path / "moved")
                shutil.copytree(tmp_path / "moved", store)
            return codec_for(*arguments)

        monkeypatch.setattr("pipeline.store.archive.codec_for", replacing)
        with pytest.raises(StoreMismatch, match="took its place"):
            archive(store, tmp_path / "second.zarr", level=1, threads=1)
        assert not list(tmp_path.glob("second.zarr*/"))


@pytest.mark.parametrize("dtype", ["<f2", "<f4", "<f8", "<u2", "<i4", "<i8", "|u1"])
@pytest.mark.parametrize("shape", [(257,), (64, 7)])
def test_the_codec_gives_back_every_bit(dtype, shape):
    """NaN with payloads, subnormals and -0.0 among them."""
    raw = np.random.default_rng(1).bytes(int(np.prod(shape)) * np.dtype(dtype).itemsize)
    values = np.frombuffer(raw, dtype).reshape(shape)
    for level in (1, 5, 22):
        codec = codec_for(values.dtype, values.nbytes, level)
        array = zarr.create_array({}, data=values, chunks=shape, compressors=[codec])
        assert array[...].tobytes() == raw


class TestDamagedStore:
    def refused(self, store: Path, match: str) -> None:
        output = store.with_name("damaged.archive.zarr")
        with pytest.raises(StoreIncomplete, match=match):
            archive(store, output, level=1, threads=2)
        assert not output.exists()
        assert not part_path(output).exists()

    def test_a_flipped_bit_names_array_file_and_rows(self, archived):
        store, _ = archived
        flip(store / "sensor/values/c/2/0", 1000)
        self.refused(store, r"sensor/values/c/2/0: expected the crc32c .*stages\.verify")

    def test_a_feature_row_other_than_its_checksum(self, archived):
        """Its file's checksum may have been written over it: only the row's own tells."""
        store, _ = archived
        path = store / "vl/features/c/1/0/0"
        flip(path, 48 * 100 + 5)
        data = path.read_bytes()[:-4]
        path.write_bytes(data + google_crc32c.value(data).to_bytes(4, "little"))
        write_seal(store)
        row = read_specs(store)["vl/features"].chunk_rows + 100
        self.refused(store, rf"c/1/0/0: rows {row} to {row} of vl/features.*stages\.verify")

    def test_changed_metadata(self, archived):
        place = archived[0] / "vl" / "zarr.json"
        place.write_text(place.read_text().replace('"slots"', '"other"'))
        self.refused(archived[0], r"metadata were changed.*stages\.verify --repair")

    def test_a_file_cut_short(self, archived):
        path = archived[0] / "state/values/c/0/0"
        os.truncate(path, path.stat().st_size - 1)
        self.refused(archived[0], r"state/values/c/0/0: expected [\d,]+ bytes")

    def test_no_store_at_all(self, tmp_path):
        self.refused(tmp_path / "s.zarr", r"Run python -m stages\.extract")


def sensor_shard(root: Path) -> Path:
    return root / "sensor/values/c/1/0"


DAMAGES: dict[str, tuple[Callable[[Path], None], str]] = {
    "bit": (lambda a: flip(sensor_shard(a), 500), r"values/c/1/0: .*sensor/values cannot be read"),
    "index": (lambda a: flip(sensor_shard(a), -9), r"values/c/1/0: .*sensor/values cannot be"),
    "short": (
        lambda a: os.truncate(sensor_shard(a), 99),
        r"values/c/1/0: .*sensor/values cannot be read",
    ),
    "missing": (
        lambda a: sensor_shard(a).unlink(),
        r"values/c/1/0: .*of sensor/values are other ones",
    ),
    "another shard": (
        lambda a: shutil.copy(a / "vl/features/c/1/0/0", a / "vl/features/c/0/0/0"),
        r"vl/features/c/0/0/0: .*vl/features",
    ),
    "array metadata": (lambda a: flip(a / "tick/action/zarr.json", 30), "tick/action/zarr.json"),
    "no array": (lambda a: shutil.rmtree(a / "tick/action"), r"zarr.json.*missing.*tick/action"),
    "manifest": (
        lambda a: (a / "zarr.json").write_text(
            (a / "zarr.json").read_text().replace("\\u00b5m", "\\u00b6m")
        ),
        r"zarr.json: .*manifest",
    ),
}


class TestDamagedArchive:
    @pytest.mark.parametrize(("damage", "match"), DAMAGES.values(), ids=DAMAGES)
    def test_is_named_and_restores_nothing(self, archived, tmp_path, damage, match):
        damage(archived[1])
        with pytest.raises(StoreIncomplete, match=f"(?s){match}"):
            restore(archived[1], tmp_path / "back.zarr", threads=2)
        assert not list(tmp_path.glob("back.zarr*/"))

    @pytest.mark.parametrize("seed", range(8))
    def test_any_flipped_byte_of_any_shard(self, archived, tmp_path, seed):
        chance = random.Random(seed)
        shards = sorted(path for path in archived[1].rglob("c/**/*") if path.is_file())
        path = chance.choice(shards)
        flip(path, chance.randrange(path.stat().st_size))
        with pytest.raises(StoreIncomplete, match=str(path)):
            restore(archived[1], tmp_path / "back.zarr", threads=2)

    def test_a_checksum_of_zarrs_that_holds_over_other_rows(self, archived, tmp_path):
        """A shard rewritten by someone, in the same size: the manifest alone tells."""
        record = zarr.open_group(archived[1], mode="r").attrs["archive"]["arrays"]["vl/key"]
        array = zarr.open_array(archived[1], path="vl/key", mode="r+")
        array[0, 0] = array[0, 0] ^ 1
        sizes = [path.stat().st_size for path in sorted((archived[1] / "vl/key").rglob("c/*/*"))]
        assert sizes == record["shard_bytes"]
        with pytest.raises(StoreIncomplete, match=r"rows 0 to .* of vl/key are other ones"):
            restore(archived[1], tmp_path / "back.zarr", threads=2)


class TestRestore:
    def test_an_equal_store_is_left_as_it_is(self, archived):
        store, output = archived
        inode = store.stat().st_ino
        restore(output, store, threads=2)
        assert store.stat().st_ino == inode

    @pytest.mark.parametrize("change", ["data", "attributes", "missing", "other"])
    def test_another_store_is_not_written_over(self, archived, change):
        store, output = archived
        path = store / "tick/action/c/0/0"
        if change == "data":
            data = bytes(path.stat().st_size - 4)
            path.write_bytes(data + google_crc32c.value(data).to_bytes(4, "little"))
        elif change == "attributes":
            zarr.open_group(store, mode="r+").attrs["note"] = "mine"
        elif change == "missing":
            path.unlink()
        else:
            shutil.rmtree(store)
            store.mkdir()
            (store / "notes").write_text("mine")
        before = content(store)
        said = r"not the archived store.*archive\.store|a folder with notes|tick/action/c/0/0: "
        with pytest.raises((StoreMismatch, ConfigError, StoreIncomplete), match=said):
            restore(output, store, threads=2)
        assert content(store) == before

    @pytest.mark.parametrize("plan", ["plan", "another plan"])
    def test_an_unfinished_extraction_is_kept(self, archived, plan):
        """Even one of the same plan: the archive may turn out to be damaged."""
        store, output = archived
        other = StoreBuild(store, read_specs(store), plan)
        shutil.rmtree(store)
        other.create()
        other.finish_layout(attributes_of(other.specs), {})
        with pytest.raises(StoreMismatch, match=r"s\.zarr\.part: .* unfinished build"):
            restore(output, store, threads=2)
        assert other.part.exists()

    def test_not_beside_a_running_extraction(self, archived, tmp_path):
        target = tmp_path / "back.zarr"
        with build_lock(target), pytest.raises(StoreLocked):
            restore(archived[1], target, threads=2)

    def test_something_that_is_no_archive(self, archived, tmp_path):
        with pytest.raises(
            StoreMismatch, match=r"expected an archive, found no manifest in its zarr\.json"
        ):
            restore(archived[0], tmp_path / "back.zarr", threads=2)
        with pytest.raises(StoreMismatch, match="expected an archive, found nothing"):
            restore(tmp_path / "no.zarr", tmp_path / "back.zarr", threads=2)


@pytest.fixture
def nearly_full_disk(small_disk) -> Path:
    """A folder on a disk with room for a quarter of the archive of the small store."""
    (small_disk / "ballast").write_bytes(bytes(8 * 2**20 - 2**17))
    folder = small_disk / "here"
    folder.mkdir()
    return folder


class TestDiskFull:
    def test_archiving_removes_what_was_begun(self, archived, nearly_full_disk):
        with pytest.raises(DiskFull, match=r"a\.zarr: no space left.*make room"):
            archive(archived[0], nearly_full_disk / "a.zarr", level=1, threads=2)
        assert [path.name for path in nearly_full_disk.iterdir()] == ["a.zarr.lock"]

    def test_restoring_removes_what_was_begun(self, archived, nearly_full_disk):
        with pytest.raises(DiskFull, match=r"back\.zarr.*no space left.*make room"):
            restore(archived[1], nearly_full_disk / "back.zarr", threads=2)
        assert [path.name for path in nearly_full_disk.iterdir()] == ["back.zarr.lock"]


SLOWED = """
import sys, time
from pathlib import Path
import pipeline.store.archive as module
from pipeline.store import schema
schema.CHUNK_BYTES, module.SHARD_BYTES, module.INNER_BYTES = 2**17, 2**18, 2**14
def slow(*arguments, real=module._read_shard):
    time.sleep(0.02)
    return real(*arguments)
module._read_shard = slow
what, source, target = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
if what == "archive":
    module.archive(source, target, 1, 2)
else:
    module.restore(source, target, 2)
"""
"""Archives or restores, slowly enough to be killed midway."""


@pytest.mark.parametrize("what", ["archive", "restore"])
@pytest.mark.parametrize(
    ("kills", "seed"), [(2, 0), *(pytest.param(6, n, marks=pytest.mark.slow) for n in range(1, 4))]
)
def test_kills_at_random_instants_end_in_the_whole(archived, tmp_path, what, kills, seed):
    chance = random.Random(seed)
    store, output = archived
    source = store if what == "archive" else output
    target = tmp_path / "target.zarr"
    hits = 0
    for _ in range(kills):
        process = subprocess.Popen([sys.executable, "-c", SLOWED, what, str(source), str(target)])
        while process.poll() is None and not part_path(target).exists():
            time.sleep(0.002)
        time.sleep(chance.uniform(0.0, 0.4))
        hits += process.poll() is None
        assert not target.exists()
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert not is_archive(part_path(target)), "only a complete archive has a manifest"
    assert hits == kills, "the kills came too late to test anything"
    if what == "archive":
        archive(store, target, level=1, threads=2)
        back = tmp_path / "back.zarr"
        restore(target, back, threads=2)
        assert content(back) == content(store)
    else:
        restore(output, target, threads=2)
        assert content(target) == content(store)
    assert not part_path(target).exists()
