"""A build loses at most what was in flight, whatever kills it."""

import errno
import os
import shutil
import subprocess
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import zarr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.base.arrays import packed_size
from pipeline.base.errors import ConfigError, StoreIncomplete, StoreLocked
from pipeline.store import (
    FeatureStore,
    RowSource,
    Sizes,
    StoreBuild,
    arrays,
    build_lock,
    part_path,
    recover,
)
from pipeline.store.chunks import check_trailers, row_checksums
from pipeline.store.paths import (
    KEPT,
    begin_build,
    builds_aside,
    is_store,
    previous_path,
    put_in_place,
    set_build_aside,
)
from pipeline.store.schema import FEATURES, TRAILER_BYTES, ArraySpec
from tests.faults.killing import Killed, killed_before
from tests.store.samples import TEXT, attributes_of, content, index_of

ROWS = 12
SIZES = Sizes(1, 24, ROWS, 0, 0, len(TEXT), 3, 8, 1, 2, 0, 0)
SPECS = arrays(SIZES, "float32", "float32")


def lay_out(build: StoreBuild) -> None:
    for name, values in index_of(build.specs).items():
        build.write(name, 0, values)
    build.finish_layout(attributes_of(build.specs), {})


def begun(folder: Path, plan: str = "plan") -> StoreBuild:
    build = StoreBuild(folder / "s.zarr", SPECS, plan)
    build.create()
    build.allocate()
    lay_out(build)
    return build


@pytest.fixture(scope="module")
def laid_out(tmp_path_factory) -> Path:
    """A folder with a laid-out build, to be copied."""
    folder = tmp_path_factory.mktemp("laid_out")
    begun(folder).close()
    return folder


@pytest.fixture(scope="module")
def full(tmp_path_factory) -> Callable[..., StoreBuild]:
    """`full(folder, plan, seed)`: a build with all its rows, a copy of one that is made once."""
    originals: dict[tuple[str, int], StoreBuild] = {}

    def copied(folder: Path, plan: str = "plan", seed: int = 0) -> StoreBuild:
        if (plan, seed) not in originals:
            build = begun(tmp_path_factory.mktemp("full"), plan)
            number = build.environment_index({"torch": plan})
            keys = [bytes([row] * 16) for row in range(ROWS)]
            build.commit(range(ROWS), rows_of(seed, ROWS), keys, number)
            build.close()
            originals[plan, seed] = build
        shutil.copytree(originals[plan, seed].part, folder / "s.zarr.part")
        return StoreBuild(folder / "s.zarr", SPECS, plan)

    return copied


def resumed(build: StoreBuild) -> StoreBuild:
    build.close()
    return StoreBuild(build.target, build.specs, build.plan)


def rows_of(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3, 8)).astype(np.float32)


def kill_everywhere(begun: Path, check: Callable[[Path, int], bool], stride: int = 1) -> int:
    """`check(a copy of begun, n)`, which kills before step n, for every n until none is left.

    Returns the first n without a kill.
    """
    for kill_at in range(0, 200, stride):
        folder = Path(shutil.copytree(begun, begun.with_name(str(kill_at)), symlinks=True))
        if not check(folder, kill_at):
            return kill_at
    raise AssertionError("more steps than expected")


class TestCommit:
    @settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(
        batches=st.lists(
            st.lists(st.integers(0, ROWS - 1), min_size=1, max_size=5, unique=True), max_size=5
        ),
        kill_at=st.integers(0, 25),
        kept=st.floats(0, 1),
    )
    def test_a_kill_at_any_write_leaves_only_whole_rows(
        self, laid_out, tmp_path_factory, batches, kill_at, kept
    ):
        """Against a dict: what is not missing after the kill is what was handed over last."""
        folder = Path(shutil.copytree(laid_out, tmp_path_factory.mktemp("kill") / "stores"))
        build = StoreBuild(folder / "s.zarr", SPECS, "plan")
        number = build.environment_index({"torch": "1"})
        expected: dict[int, tuple[np.ndarray, bytes]] = {}
        offered: dict[int, list[tuple[np.ndarray, bytes]]] = {}
        writes = iter(range(10**6))
        real = os.pwrite

        def pwrite(descriptor, block, offset):
            if next(writes) == kill_at:
                real(descriptor, bytes(block)[: int(len(block) * kept)], offset)
                raise Killed
            return real(descriptor, block, offset)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "pwrite", pwrite)
            try:
                for index, rows in enumerate(batches):
                    features = rows_of(index, len(rows))
                    keys = [bytes([index, row] * 8) for row in rows]
                    pairs = dict(zip(rows, zip(features, keys, strict=True), strict=True))
                    for row, pair in pairs.items():
                        offered.setdefault(row, []).append(pair)
                    build.commit(rows, features, keys, number)
                    expected |= pairs
            except Killed:
                pass
        again = resumed(build)
        missing = set(again.missing().tolist())
        rewritten = {row for row in offered if len(offered[row]) > 1}
        assert not missing & (set(expected) - rewritten), "a committed row was lost"
        for row in set(range(ROWS)) - missing:
            stored = again.files(FEATURES).read(row, 1)[0]
            assert any(np.array_equal(stored, features) for features, _ in offered[row])
        again.close()

    def test_a_damaged_row_counts_as_missing(self, tmp_path):
        build = begun(tmp_path)
        build.commit(range(ROWS), rows_of(0, ROWS), [bytes(16)] * ROWS, 0)
        path = build.files(FEATURES).paths[0]
        with path.open("r+b") as file:
            file.seek(5 * 3 * 8 * 4 + 17)
            file.write(b"\xff")
        assert resumed(build).missing().tolist() == [5]

    def test_zero_checksums_are_kept_as_one(self, monkeypatch):
        monkeypatch.setattr("google_crc32c.value", lambda row: 0)
        assert row_checksums(np.ones((2, 3), np.float32)).tolist() == [1, 1]


class TestSeal:
    def test_zarr_refuses_features_until_sealed(self, full, tmp_path):
        build = full(tmp_path)
        with pytest.raises(ValueError, match="checksum"):
            zarr.open_array(build.part, path=FEATURES, mode="r")[:]
        build.seal()
        assert np.array_equal(
            zarr.open_array(build.target, path=FEATURES, mode="r")[:], rows_of(0, ROWS)
        )
        assert not build.part.exists()

    def test_refuses_an_incomplete_build(self, tmp_path):
        build = begun(tmp_path)
        build.commit([0], rows_of(0, 1), [bytes(16)], 0)
        with pytest.raises(StoreIncomplete, match="11 feature rows are missing, the first is 1"):
            build.seal()

    @pytest.mark.parametrize(
        ("replaces", "steps", "stride"),
        [
            (False, ((os, "pwrite"), (os, "fsync")), 13),
            (True, ((Path, "rename"), (Path, "unlink"), (shutil, "rmtree")), 1),
        ],
    )
    def test_a_kill_at_any_step_is_mended_by_sealing_again(
        self, full, tmp_path, replaces, steps, stride
    ):
        """Kill before the n-th of these steps, for every n (or every 13th), until none is left."""
        begun = tmp_path / "begun"
        if replaces:
            full(begun, "before", seed=1).seal()
        full(begun, "after").close()

        def check(folder: Path, kill_at: int) -> bool:
            build = StoreBuild(folder / "s.zarr", SPECS, "after")
            killed = killed_before(kill_at, build.seal, steps)
            if killed:
                recover(build.target)
                if build.part.exists():
                    resumed(build).seal()
            store = FeatureStore.open(build.target)
            assert np.array_equal(store.array(FEATURES), rows_of(0, ROWS))
            assert store.attrs["environment"] == [{"rows": [0, ROWS], "torch": "after"}]
            assert [path.name for path in folder.iterdir()] == ["s.zarr"]
            return killed

        assert kill_everywhere(begun, check, stride) >= 4

    def test_a_kill_while_the_old_is_kept_is_mended_by_sealing_again(self, full, tmp_path):
        """Kill before the n-th change of the folders, for every n, until none is left."""
        built = tmp_path / "built"
        full(built, "before", seed=1).seal()
        full(built, "after").finish()

        def check(folder: Path, kill_at: int) -> bool:
            target, previous = folder / "s.zarr", folder / "s.zarr.previous"
            killed = killed_before(kill_at, lambda: put_in_place(target, keep=True))
            recover(target)
            assert not KEPT.marks(target)
            if part_path(target).exists():
                put_in_place(target, keep=True)
            for store, seed in ((target, 0), (previous, 1)):
                assert np.array_equal(FeatureStore.open(store).array(FEATURES), rows_of(seed, ROWS))
            assert KEPT.owns(previous)
            assert {*os.listdir(folder)} == {"s.zarr", "s.zarr.previous"}
            assert sorted(os.listdir(target)) == sorted(os.listdir(built / "s.zarr"))
            return killed

        assert kill_everywhere(built, check) >= 3

    @pytest.mark.parametrize("link", [False, True])
    def test_a_copy_or_link_of_the_user_is_not_the_kept_store(self, full, tmp_path, link):
        full(tmp_path, "before", seed=1).seal()
        full(tmp_path, "after").finish()
        previous = previous_path(tmp_path / "s.zarr")
        if link:
            previous.symlink_to("s.zarr")
        else:
            shutil.copytree(tmp_path / "s.zarr", previous)
        with pytest.raises(ConfigError, match=r"s\.zarr\.previous"):
            put_in_place(tmp_path / "s.zarr", keep=True)
        assert FeatureStore.open(tmp_path / "s.zarr").attrs["plan"] == "before"
        put_in_place(tmp_path / "s.zarr")
        assert previous.is_symlink() == link
        assert previous.exists()

    def test_a_kill_at_any_step_of_setting_a_build_aside_keeps_its_rows(self, tmp_path):
        build = begun(tmp_path / "begun")
        build.commit([3], rows_of(0, 1), [bytes(16)], build.environment_index({"torch": "1"}))
        build.close()

        def check(folder: Path, kill_at: int) -> bool:
            target = folder / "s.zarr"
            killed = killed_before(kill_at, lambda: set_build_aside(target))
            recover(target)
            (known,) = [*filter(is_store, [part_path(target)]), *builds_aside(target)]
            row, environment = RowSource(known).take(bytes(16)) or (None, {})
            assert np.array_equal(row, rows_of(0, 1)[0])
            assert environment == {"torch": "1"}
            begin_build(target)
            assert killed or [known] == builds_aside(target)
            return killed

        assert kill_everywhere(tmp_path / "begun", check) >= 2

    def test_a_finished_store_replaced_is_never_written(self, full, tmp_path):
        full(tmp_path, "before", seed=1).seal()
        kept = tmp_path / "kept"
        subprocess.run(["cp", "-al", tmp_path / "s.zarr", kept], check=True)
        before = content(kept)
        full(tmp_path, "after").seal()
        assert content(kept) == before

    @pytest.mark.parametrize("keep", [False, True])
    def test_a_store_behind_a_symbolic_link_loses_the_link_alone(self, full, tmp_path, keep):
        full(tmp_path / "disk", "before", seed=1).seal()
        (tmp_path / "s.zarr").symlink_to(tmp_path / "disk" / "s.zarr")
        full(tmp_path, "after").seal(keep=keep)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["disk", "s.zarr"]
        assert not (tmp_path / "s.zarr").is_symlink()
        behind = FeatureStore.open(tmp_path / "disk" / "s.zarr")
        assert np.array_equal(behind.array(FEATURES), rows_of(1, ROWS))

    @pytest.mark.parametrize("name", [FEATURES, "vl/key", "vl/checksum"])
    def test_a_trailer_that_a_power_loss_left_out_costs_no_row(self, full, tmp_path, name):
        build = full(tmp_path)
        (path,) = build.files(name).paths
        data = build.specs[name].chunk_bytes
        os.truncate(path, data)
        os.truncate(path, data + TRAILER_BYTES)  # its size reached the disk, its end did not
        again = resumed(build)
        assert not again.missing().size
        again.seal()
        check_trailers(build.target)
        assert np.array_equal(FeatureStore.open(build.target).array(FEATURES), rows_of(0, ROWS))


class TestLinks:
    @pytest.mark.parametrize("harm", [None, lambda path: os.truncate(path, 99), Path.unlink])
    def test_whole_unchanged_chunks_are_linked_and_others_are_written(
        self, tmp_path, monkeypatch, harm
    ):
        monkeypatch.setattr("pipeline.store.schema.CHUNK_BYTES", 4096)
        name, target = "sensor/values", tmp_path / "s.zarr"
        values = np.random.default_rng(0).normal(size=(14_000, 3)).astype(np.float32)
        self.build(target, values[:9000]).seal()
        (first, second, _) = (target / name / "c" / str(chunk) / "0" for chunk in range(3))
        inodes = [path.stat().st_ino for path in (first, second)]
        if harm is not None:
            harm(first)
        longer = self.build(target, values, RowSource(target).specs[name])
        linked = [longer.files(name).is_linked(chunk) for chunk in range(4)]
        assert linked == [harm is None, True, False, False], "the third holds the stream's end"
        paths = longer.files(name).paths
        same = [path.stat().st_ino == inode for path, inode in zip(paths, inodes, strict=False)]
        assert same == linked[:2]
        longer.seal()
        assert np.array_equal(FeatureStore.open(target).array(name), values)

    def build(
        self, target: Path, readings: np.ndarray, source: ArraySpec | None = None
    ) -> StoreBuild:
        """A build with all its rows, whose first 9,000 readings are linked from the source."""
        sizes = Sizes(1, 2, 1, len(readings), 0, len(TEXT), 1, 2, 1, 2, 3, 0)
        build = StoreBuild(target, arrays(sizes, "float32", "float32"), str(len(readings)))
        build.create()
        if source is not None:
            build.link_unchanged("sensor/values", target, source, 9000)
        build.allocate()
        build.write("sensor/values", 0, readings)
        lay_out(build)
        build.commit([0], np.zeros((1, 1, 2), np.float32), [bytes(16)], 0)
        return build


class TestLock:
    def test_the_second_builder_is_refused_and_told_of_the_first(self, tmp_path):
        """Two descriptors of a file exclude each other like two processes."""
        target = tmp_path / "s.zarr"
        with (
            build_lock(target),
            pytest.raises(StoreLocked, match=f"process {os.getpid()}"),
            build_lock(target),
        ):
            pass
        with build_lock(target):
            pass

    def test_a_dead_process_left_nothing(self, tmp_path):
        (tmp_path / "s.zarr.lock").write_text("process 1 on elsewhere\n")
        with build_lock(tmp_path / "s.zarr"):
            assert f"process {os.getpid()}" in (tmp_path / "s.zarr.lock").read_text()

    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (os.mkfifo, "found a pipe"),
            (lambda path: path.symlink_to("nowhere"), "no such file"),
            (lambda path: path.write_bytes(b"x" * 10**7), "at most 1,000 bytes, found 10,000,000"),
            (lambda path: path.write_bytes(b"\xff\x00\x1b" * 20), "did not write"),
            (lambda path: path.write_text("process 7 on elsewhere\nmy thesis\n"), "did not write"),
        ],
    )
    def test_what_is_no_lock_is_left_as_it_is(self, tmp_path, make, message):
        path = tmp_path / "s.zarr.lock"
        make(path)
        before = path.lstat()
        refused = pytest.raises(ConfigError, match=f"s.zarr.lock: .*{message}.*move it away")
        with refused, build_lock(tmp_path / "s.zarr"):
            pass
        assert not (tmp_path / "nowhere").exists()
        assert (path.lstat().st_size, path.lstat().st_mtime) == (before.st_size, before.st_mtime)

    def test_without_flock_a_build_goes_on_with_a_note(self, tmp_path, monkeypatch, capsys):
        def unsupported(*_: object) -> None:
            raise OSError(errno.EOPNOTSUPP, "Operation not supported")

        monkeypatch.setattr("fcntl.flock", unsupported)
        with build_lock(tmp_path / "s.zarr"):
            assert "has no locks" in capsys.readouterr().err


any_array = given(
    rows=st.integers(0, 10**8),
    width=st.integers(1, 200_000),
    dtype=st.sampled_from(["u1", "f2", "f4", "f8"]),
)


class TestChunkRule:
    @any_array
    def test_chunks_of_features_are_whole_pages_and_never_huge(self, rows, width, dtype):
        spec = ArraySpec("vl/features", (rows, 16, width), np.dtype(dtype))
        assert spec.chunk_bytes % 4096 == 0
        assert spec.chunk_rows <= 4096 or spec.chunk_bytes <= 64 * 2**20
        least = spec.chunk_rows == spec.row_multiple
        assert least or spec.chunk_bytes <= 64 * 2**20
        assert 0 <= spec.chunk_count * spec.chunk_rows - rows < spec.chunk_rows or not rows
        # Grids and all tokens of three views of 360 x 640 and wider models.
        for slots, dim in product((49, 299, 897), (2048, 3584)):
            for held, kind in (("f2", "float16"), ("i1", "int8"), ("u1", "float8")):
                shape = (rows, slots, packed_size(kind, dim))
                assert ArraySpec("vl/features", shape, np.dtype(held)).chunk_bytes <= 110e6

    @any_array
    def test_chunks_are_multiples_of_4096_rows_of_about_64_mb(self, rows, width, dtype):
        spec = ArraySpec("x", (rows, width), np.dtype(dtype))
        assert spec.chunk_rows % 4096 == 0
        assert spec.chunk_bytes % 4096 == 0
        assert spec.chunk_rows == 4096 or spec.chunk_bytes <= 64 * 2**20
        assert spec.chunk_count * spec.chunk_rows >= rows
        if spec.data_bytes and spec.chunk_count > 1:
            assert spec.chunk_rows == 4096 or spec.chunk_bytes > 32 * 2**20
