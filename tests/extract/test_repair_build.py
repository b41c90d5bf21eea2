"""A repair takes over all that is sound, touches nothing, and may be killed at any step."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import google_crc32c
import numpy as np
import pytest

from pipeline.base.errors import StoreMismatch
from pipeline.extract.repair import begin_from_store, layout_is_sound
from pipeline.store import FeatureStore, StoreBuild, part_path, read_plan
from pipeline.store.chunks import write_seal
from pipeline.store.schema import chunk_paths, read_spec, read_specs
from pipeline.store.verification import verify
from tests.extract.conftest import contents
from tests.faults.killing import killed_before

ROW_BYTES = 3 * 8 * 4


@pytest.fixture(scope="module")
def original(tiny_store, tmp_path_factory) -> Path:
    return tiny_store(tmp_path_factory.mktemp("original"))


@pytest.fixture
def store(original, tmp_path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "tiny.zarr"))


def chunk_file(store: Path, array: str, chunk: int = 0) -> Path:
    return chunk_paths(store, read_spec(store, array))[chunk]


def flip(path: Path, byte: int) -> None:
    content = bytearray(path.read_bytes())
    content[byte] ^= 0x40
    path.write_bytes(content)


def repaired(store: Path) -> StoreBuild:
    """The build that `stages.extract` would find."""
    verification = verify(store, threads=1)
    assert layout_is_sound(verification)
    begin_from_store(verification)
    return StoreBuild(store, read_specs(part_path(store)), read_plan(part_path(store)) or "")


def completed(build: StoreBuild, original: Path) -> Path:
    """The store that comes of computing what is missing, as the original has it."""
    known = FeatureStore.open(original)
    missing = build.missing()
    if len(missing):
        keys = [known.array("vl/key")[row].tobytes() for row in missing]
        number = build.environment_index({"torch": "test"})
        build.commit(missing, known.array("vl/features")[missing], keys, number)
    build.seal()
    return build.target


def truncate(path: Path) -> None:
    os.truncate(path, 50 * ROW_BYTES + 10)


def flip_row_17(path: Path) -> None:
    flip(path, 17 * ROW_BYTES + 3)


EVERY_ROW = list(range(60))
DAMAGES: list[tuple[str, Callable[[Path], object], list[int]]] = [
    ("vl/features", flip_row_17, [17]),
    ("vl/features", truncate, list(range(50, 60))),
    ("vl/features", Path.unlink, EVERY_ROW),
    ("vl/features", lambda path: flip(path, 2048 * ROW_BYTES), []),  # the trailer alone
    ("vl/key", lambda path: flip(path, 5), EVERY_ROW),
    ("vl/checksum", Path.unlink, []),
]


@pytest.mark.parametrize(("array", "harm", "missing"), DAMAGES)
def test_what_is_damaged_is_missing_and_completed_it_is_the_original(
    original, store, array, harm, missing
):
    harm(chunk_file(store, array))
    damaged = contents(store)
    build = repaired(store)
    assert build.missing().tolist() == missing
    assert contents(store) == damaged, "the damaged store is only read from"
    assert contents(completed(build, original)) == contents(original)
    assert sorted(path.name for path in store.parent.iterdir()) == ["tiny.zarr"]


def test_a_nan_with_right_checksums_is_missing(original, store):
    path = chunk_file(store, "vl/features")
    content = bytearray(path.read_bytes()[:-4])
    row = np.full((3, 8), np.nan, np.float32).tobytes()
    content[22 * ROW_BYTES : 23 * ROW_BYTES] = row
    path.write_bytes(content + google_crc32c.value(bytes(content)).to_bytes(4, "little"))
    marks = chunk_file(store, "vl/checksum")
    content = bytearray(marks.read_bytes()[:-4])
    content[22 * 4 : 23 * 4] = google_crc32c.value(row).to_bytes(4, "little")
    marks.write_bytes(content + google_crc32c.value(bytes(content)).to_bytes(4, "little"))
    write_seal(store)
    build = repaired(store)
    assert build.missing().tolist() == [22]
    assert contents(completed(build, original)) == contents(original)


def test_sound_chunks_are_linked_where_files_can_be(tiny_store, tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.store.schema.CHUNK_BYTES", 4096)
    store = tiny_store(tmp_path, episodes=2, ticks=2100, reuse=1)
    kept = contents(store)
    flip(chunk_file(store, "vl/features", 0), 17 * ROW_BYTES)
    build = repaired(store)

    def shared(array: str, chunk: int = 0) -> bool:
        ours, theirs = build.files(array).paths[chunk], chunk_file(store, array, chunk)
        return ours.stat().st_ino == theirs.stat().st_ino

    assert shared("sensor/values")
    assert shared("vl/features", 1)
    assert not shared("vl/features", 0)
    assert not shared("vl/checksum")
    rows = build.missing()
    assert rows.tolist() == [17]
    features = np.frombuffer(kept["vl/features/c/0/0/0"][: 18 * ROW_BYTES], np.float32)[-24:]
    key = kept["vl/key/c/0/0"][17 * 16 : 18 * 16]
    build.commit(rows, features.reshape(1, 3, 8), [key], build.environment_index({"torch": "test"}))
    build.seal()
    assert contents(store) == kept


def test_they_are_copied_where_not(original, store, monkeypatch):
    monkeypatch.setattr("pipeline.store.chunks.ChunkFiles.link", lambda *_: False)
    flip_row_17(chunk_file(store, "vl/features"))
    build = repaired(store)
    assert build.missing().tolist() == [17]
    assert contents(completed(build, original)) == contents(original)


def test_a_store_that_was_replaced_since_it_was_checked_gives_no_row(original, store):
    flip_row_17(chunk_file(store, "vl/features"))
    verification = verify(store, threads=1)
    store.rename(store.with_name("before.zarr"))
    shutil.copytree(original, store)
    with pytest.raises(StoreMismatch, match=r"another store took its place.*Run the same"):
        begin_from_store(verification)


def test_a_kill_at_any_step_leaves_the_store_and_a_repair_to_be_started_again(original, tmp_path):
    steps = [
        (os, "link"),
        (os, "pwrite"),
        (os, "fdatasync"),
        (Path, "rename"),
        (shutil, "copyfile"),
    ]
    for kill_at in range(0, 200, 5):
        store = Path(shutil.copytree(original, tmp_path / str(kill_at) / "tiny.zarr"))
        flip_row_17(chunk_file(store, "vl/features"))
        damaged, builds = contents(store), list[StoreBuild]()
        killed = killed_before(kill_at, lambda: builds.append(repaired(store)), steps)  # noqa: B023
        assert contents(store) == damaged
        if killed:
            assert read_plan(part_path(store)) is None, "nothing half begun"
            builds.append(repaired(store))
        (build,) = builds
        assert build.missing().tolist() == [17]
        build.close()
        if not killed:
            assert kill_at > 10
            return
    raise AssertionError("a repair takes more steps than expected")
