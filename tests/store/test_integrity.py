"""Whatever is wrong with a store is found and named; a sound one is left in peace."""

import errno
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import distributed
import google_crc32c
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.base.errors import StoreIncomplete, StoreMismatch
from pipeline.base.format import size
from pipeline.store import FeatureStore, check_trailers
from pipeline.store.archive import archive
from pipeline.store.integrity import verify
from pipeline.store.integrity.findings import MOST_LINES, Findings
from pipeline.store.integrity.scan import ChunkReport
from pipeline.store.schema import chunk_paths, read_spec

TICKS, REUSE = 30, 3
ROWS = TICKS // REUSE


@pytest.fixture(scope="module")
def original(tiny_store, tmp_path_factory) -> Path:
    return tiny_store(tmp_path_factory.mktemp("original"))


@pytest.fixture
def store(original, tmp_path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "tiny.zarr"))


def chunk_file(store: Path, array: str, chunk: int = 0) -> Path:
    return chunk_paths(store, read_spec(store, array))[chunk]


def flip(path: Path, byte: int, bit: int = 0) -> None:
    content = bytearray(path.read_bytes())
    content[byte] ^= 1 << bit
    path.write_bytes(content)


def overwrite(store: Path, array: str, row: int, value: object) -> None:
    """Put a value into a row, and the right trailer behind it, as wrong software would."""
    spec, path = read_spec(store, array), chunk_file(store, array)
    content = bytearray(path.read_bytes()[:-4])
    values = np.frombuffer(content, spec.dtype).reshape(-1, *spec.shape[1:])
    values[row] = value
    path.write_bytes(bytes(content) + google_crc32c.value(bytes(content)).to_bytes(4, "little"))


def nan_with_right_checksums(store: Path, row: int) -> None:
    overwrite(store, "vl/features", row, np.nan)
    spec = read_spec(store, "vl/features")
    values = np.full(spec.shape[1:], np.nan, spec.dtype)
    overwrite(store, "vl/checksum", row, google_crc32c.value(values.tobytes()))


def edit(path: Path, change: Callable[[dict], object]) -> None:
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def found_in(store: Path) -> Findings:
    before = {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}
    findings = verify(store, threads=2)
    after = {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}
    assert after == before, "a check writes nothing"
    return findings


class TestSound:
    @pytest.mark.parametrize(
        "changed",
        [
            {},
            {"dtype": "float16"},
            {"dtype": "bfloat16"},
            {"sensor_channels": 0, "state_dim": 0},
            {"ticks": 31, "episodes": 1},
        ],
    )
    def test_nothing_is_found(self, tiny_store, tmp_path, changed):
        findings = found_in(tiny_store(tmp_path, **changed))
        assert findings.lines() == []
        assert findings.sound

    def test_every_byte_is_read(self, store):
        findings = found_in(store)
        files = [path for path in store.rglob("*") if path.is_file() and path.name != "zarr.json"]
        assert findings.bytes == sum(path.stat().st_size for path in files)
        specs = [read_spec(store, path.parent.relative_to(store)) for path in store.glob("*/*/c")]
        assert findings.row_bytes == sum(spec.data_bytes for spec in specs)
        assert f"{size(findings.row_bytes)} of rows in" in findings.summary()
        assert findings.rows == 6 * ROWS

    def test_over_several_chunks_and_blocks(self, tiny_store, tmp_path, monkeypatch):
        monkeypatch.setattr("pipeline.store.schema.CHUNK_BYTES", 4096)
        monkeypatch.setattr("pipeline.store.chunk_pass.BLOCK_BYTES", 10_000)
        monkeypatch.setattr("pipeline.store.integrity.invariants.BLOCK_ROWS", 7)
        store = tiny_store(tmp_path, readings_a_tick=60)
        assert found_in(store).sound
        flip(chunk_file(store, "sensor/values", 1), 77)
        (damage,) = found_in(store).damaged
        assert (damage.array, damage.chunk) == ("sensor/values", 1)
        assert "rows 4096 (episode 'episode_002') to 8191 (episode 'episode_004')" in damage.what

    @pytest.mark.slow
    def test_workers_find_what_threads_find_and_nobody_else_reaches_them(self, store, monkeypatch):
        addresses = []

        class Noting(distributed.Client):
            def __init__(self, *where, **settings):
                super().__init__(*where, **settings)
                addresses.append(self.scheduler.address)

        monkeypatch.setattr("distributed.Client", Noting)
        flip(chunk_file(store, "vl/features"), 17 * 3 * 8 * 4)
        overwrite(store, "tick/vl_row", 31, 9)
        here, there = verify(store, threads=2), verify(store, threads=1, workers=2)
        assert there.lines() == here.lines()
        assert here.bad_rows.tolist() == [17]
        assert addresses and all(one.startswith("tls://") for one in addresses)


class TestFeatureRows:
    def test_a_flipped_bit_names_row_episode_and_tick(self, store):
        flip(chunk_file(store, "vl/features"), 17 * 3 * 8 * 4 + 5, bit=6)
        findings = found_in(store)
        assert findings.bad_rows.tolist() == [17]
        assert [(one.array, one.chunk) for one in findings.damaged] == [("vl/features", 0)]
        said = "\n".join(findings.lines())
        assert "VL row 17 (episode 'episode_001', tick 51): its bytes do not give its" in said
        assert str(chunk_file(store, "vl/features")) in said

    def test_a_row_that_another_program_wrote(self, store):
        overwrite(store, "vl/features", 3, 1.0)
        findings = found_in(store)
        assert findings.bad_rows.tolist() == [3]
        assert not findings.damaged, "the file is as it was written"

    def test_a_row_that_was_never_written(self, store):
        overwrite(store, "vl/checksum", 4, 0)
        findings = found_in(store)
        assert findings.bad_rows.tolist() == [4]
        assert "never written" in findings.lines()[0]

    def test_a_nan_with_right_checksums(self, store):
        nan_with_right_checksums(store, 22)
        findings = found_in(store)
        assert findings.bad_rows.tolist() == [22]
        assert findings.lines() == ["VL row 22 (episode 'episode_002', tick 66): NaN or infinity"]

    @pytest.mark.parametrize(("dtype", "bits"), [("float16", 0x7C00), ("bfloat16", 0xFF80)])
    def test_infinities_of_narrow_dtypes(self, tiny_store, tmp_path, dtype, bits):
        store = tiny_store(tmp_path, dtype=dtype)
        stored = FeatureStore.open(store).array("vl/features")[5].copy()
        stored.view(np.uint16)[1, 2] = bits
        overwrite(store, "vl/features", 5, stored)
        overwrite(store, "vl/checksum", 5, google_crc32c.value(stored.tobytes()))
        assert [line.split(": ")[1] for line in found_in(store).lines()] == ["NaN or infinity"]

    def test_a_nan_in_a_slot_of_a_missing_view_is_nobodys(self, store):
        nan_with_right_checksums(store, 22)
        overwrite(store, "vl/slot_valid", 22, 0)
        assert found_in(store).sound

    def test_a_nan_is_one_where_the_file_that_excuses_it_is_gone(self, store):
        nan_with_right_checksums(store, 22)
        overwrite(store, "vl/slot_valid", 22, 0)
        chunk_file(store, "vl/slot_valid").unlink()
        findings = found_in(store)
        assert findings.bad_rows.tolist() == [22]
        assert findings.damaged_arrays() == {"vl/slot_valid"}

    def test_rows_behind_the_end_of_a_truncated_file(self, store):
        os.truncate(chunk_file(store, "vl/features"), 50 * 3 * 8 * 4 + 10)
        findings = found_in(store)
        assert findings.bad_rows.tolist() == list(range(50, 60))
        assert findings.rows == 50
        assert "expected 393220 bytes, found 4810" in findings.lines()[0]
        assert all("not in its file" in line for line in findings.lines()[1:])

    def test_a_file_that_is_gone(self, store):
        chunk_file(store, "vl/features").unlink()
        findings = found_in(store)
        assert findings.bad_rows.tolist() == list(range(60))
        assert "found none (No such file or directory)" in findings.lines()[0]
        assert findings.rows == 0
        assert findings.lines()[1:] == [
            "VL rows 0 (episode 'episode_000', tick 0) to 59 (episode 'episode_005', tick 177): "
            "not in its file"
        ]

    def test_many_runs_of_rows_are_capped(self, store):
        for row in range(0, 60, 2):
            overwrite(store, "vl/features", row, 1.0)
        lines = found_in(store).lines()
        assert len(lines) == MOST_LINES + 1
        assert lines[-1].startswith("and 10 more VL rows")

    def test_rows_on_a_disk_that_fails(self, store, monkeypatch):
        monkeypatch.setattr("pipeline.store.chunk_pass.BLOCK_BYTES", 10 * 3 * 8 * 4)
        read, inode = os.preadv, chunk_file(store, "vl/features").stat().st_ino

        def failing(descriptor, buffers, offset):
            if os.fstat(descriptor).st_ino == inode and offset >= 50 * 3 * 8 * 4:
                raise OSError(errno.EIO, "Input/output error")
            return read(descriptor, buffers, offset)

        monkeypatch.setattr(os, "preadv", failing)
        findings = verify(store, threads=1)
        assert findings.bad_rows.tolist() == list(range(50, 60))
        assert "cannot be read at byte 4800: Input/output error" in findings.lines()[0]

    @pytest.mark.parametrize("harm", [Path.unlink, lambda path: flip(path, 4 * 11)])
    def test_rows_are_good_where_only_their_checksums_are_lost(self, store, harm):
        harm(chunk_file(store, "vl/checksum"))
        findings = found_in(store)
        assert not len(findings.bad_rows)
        assert findings.damaged_arrays() == {"vl/checksum"}


class TestOtherArrays:
    @pytest.mark.parametrize(
        ("array", "row", "value", "said"),
        [
            ("tick/action", 33, np.nan, "NaN or infinity in row 33 (episode 'episode_001', tick"),
            ("sensor/values", 250, np.inf, "NaN or infinity in row 250 (episode 'episode_001')"),
            ("state/time", 5, np.nan, "NaN or infinity in row 5 (episode 'episode_000')"),
            ("vl/frame_time", 5, np.inf, "an infinite time in row 5"),
            ("sensor/time", 250, -1.0, "the clock goes backwards in row 250 (episode 'episode_001"),
            ("tick/time", 89, 0.1, "backwards in row 89 (episode 'episode_002', tick 89)"),
            ("tick/vl_row", 31, 9, "not the VL row of its 3 ticks in row 31 (episode 'episode_001"),
            ("tick/sensor_end", 31, 9, "not a position in its episode, or before an earlier one"),
            ("tick/state_end", 31, 10**9, "not a position in its episode"),
            ("episode/vl_start", 1, 9, "episode 0: expected 10 VL rows, found 9"),
            ("episode/tick_start", 0, 1, "expected offsets from 0 to 180, found 1 to 180"),
            ("episode/sensor_start", 3, 10**9, "the offsets go back after episode 3"),
            ("episode/source", 2, 2, "episode 2: source 2 of 2"),
            ("episode/text", 0, 0, "episode 0: expected a JSON object with"),
        ],
    )
    def test_what_wrong_software_wrote(self, store, array, row, value, said):
        overwrite(store, array, row, value)
        findings = found_in(store)
        assert findings.damaged_arrays() == {array}
        assert any(said in line for line in findings.lines()), findings.lines()
        assert not len(findings.bad_rows)

    @settings(
        max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
    )
    @given(data=st.data())
    def test_any_flipped_bit_of_any_chunk_is_found(self, original, tmp_path_factory, data):
        store = Path(shutil.copytree(original, tmp_path_factory.mktemp("flip") / "tiny.zarr"))
        files = sorted(path for path in store.rglob("c/**/*") if path.is_file())
        path = data.draw(st.sampled_from(files))
        flip(path, data.draw(st.integers(0, path.stat().st_size - 1)), data.draw(st.integers(0, 7)))
        findings = verify(store, threads=1)
        array = path.relative_to(store).as_posix().split("/c/")[0]
        assert findings.damaged_arrays() == {array}
        assert {one.file for one in findings.damaged} == {path}


class TestStructure:
    @pytest.mark.parametrize(
        ("array", "change", "said"),
        [
            ("tick/time", lambda one: one.update(shape=[179]), "expected the shape"),
            ("tick/time", lambda one: one.update(data_type="float32"), "expected the dtype"),
            ("tick/time", lambda one: one.update(dimension_names=["time"]), "the dimensions"),
            ("tick/time", lambda one: one["codecs"].pop(), "expected the codecs"),
            (
                "tick/time",
                lambda one: one["chunk_key_encoding"]["configuration"].update(separator="."),
                "expected the chunk keys",
            ),
            (
                "tick/action",
                lambda one: one["chunk_grid"]["configuration"].update(chunk_shape=[100, 5]),
                "expected chunks of a multiple of 4096 whole rows",
            ),
            ("tick/time", lambda one: one.clear(), "not the metadata of a zarr array"),
        ],
    )
    def test_metadata_of_an_array(self, store, array, change, said):
        edit(store / array / "zarr.json", change)
        findings = found_in(store)
        assert array in findings.damaged_arrays()
        assert any(said in line for line in findings.lines()), findings.lines()

    def test_an_array_that_is_gone(self, store):
        shutil.rmtree(store / "state" / "values")
        assert any("the array state/values is missing" in line for line in found_in(store).lines())

    @pytest.mark.parametrize(
        ("place", "change", "said"),
        [
            ("zarr.json", lambda at: at.pop("plan"), "attribute plan is missing"),
            ("zarr.json", lambda at: at.update(schema=2), "expected schema 1, found 2"),
            ("zarr.json", lambda at: at["streams"]["action"]["names"].pop(), "4 names of action"),
            ("zarr.json", lambda at: at["streams"]["views"].pop(), "0 views, vl/frame_time has 1"),
            ("vl/zarr.json", lambda at: at["slots"].pop(), "2 slots are named, vl/features has 3"),
            ("vl/zarr.json", lambda at: at.clear(), "the names of the slots cannot be read"),
        ],
    )
    def test_attributes(self, store, place, change, said):
        edit(store / place, lambda document: change(document["attributes"]))
        findings = found_in(store)
        assert findings.damaged_arrays() == {""}
        assert any(said in line for line in findings.lines()), findings.lines()

    @pytest.mark.parametrize(
        ("place", "change"),
        [
            ("zarr.json", lambda at: at.update(action_hz=30.0)),
            ("zarr.json", lambda at: at["streams"]["action"]["units"].reverse()),
            ("vl/zarr.json", lambda at: at["slots"][0].update(pooling="last")),
            ("sensor/values/zarr.json", lambda at: at.update(note="mine")),
            ("tick/zarr.json", lambda at: at.update(note="mine")),
        ],
    )
    def test_plausible_metadata_that_were_changed(self, store, place, change):
        edit(store / place, lambda document: change(document["attributes"]))
        findings = found_in(store)
        assert not findings.sound
        assert findings.damaged_arrays() >= {""} or "sensor" in place
        with pytest.raises(StoreIncomplete, match=rf"metadata were changed.*verify.store={store}"):
            check_trailers(store)

    def test_metadata_of_an_earlier_version_have_no_digest(self, store):
        edit(store / "zarr.json", lambda document: document["attributes"].pop("metadata_digest"))
        findings = found_in(store)
        assert findings.sound
        assert "attributes cannot be checked" in findings.notes[0]
        check_trailers(store)

    def test_metadata_that_are_no_json(self, store):
        (store / "zarr.json").write_text("{")
        findings = found_in(store)
        assert "not a zarr group's metadata" in findings.lines()[0]
        assert "--repair cannot begin" in findings.advice()
        assert "--restore" not in findings.advice()
        (store.with_name("tiny.archive.zarr")).mkdir()
        (store.with_name("tiny.archive.zarr") / "zarr.json").touch()
        assert f"archive.store={store}" in findings.advice()

    def test_files_that_have_no_place(self, store):
        (store / "tick" / "notes.txt").touch()
        (store / ".environments.json").touch()
        findings = found_in(store)
        assert [line.split(": ")[0] for line in findings.lines()] == [
            str(store / ".environments.json"),
            str(store / "tick" / "notes.txt"),
        ]
        assert "remove them" in findings.advice()


class TestOtherThings:
    def test_nothing_there(self, tmp_path):
        with pytest.raises(StoreIncomplete, match="nothing there"):
            verify(tmp_path / "no.zarr", threads=1)

    @pytest.mark.parametrize("name", ["empty", "other"])
    def test_a_folder_that_is_no_store(self, tmp_path, monkeypatch, name):
        (tmp_path / name).mkdir()
        (tmp_path / "other" / "x").mkdir(parents=True)
        monkeypatch.setattr(os, "walk", lambda _: pytest.fail("walked"))
        with pytest.raises(StoreIncomplete, match=r"no store.*verify\.store"):
            verify(tmp_path / name, threads=1)

    def test_an_unfinished_build(self, store):
        store.rename(store.with_name("tiny.zarr.part"))
        with pytest.raises(StoreIncomplete, match="only the unfinished build"):
            verify(store, threads=1)
        with pytest.raises(StoreIncomplete, match="an unfinished build"):
            verify(store.with_name("tiny.zarr.part"), threads=1)

    def test_workers_that_do_not_see_the_store(self, store, monkeypatch):
        def elsewhere(tasks, threads, workers, label):
            return [ChunkReport(one.array, one.chunk, 0, "expected a chunk file") for one in tasks]

        monkeypatch.setattr("pipeline.store.integrity.verification.run_tasks", elsewhere)
        with pytest.raises(StoreIncomplete, match="a file system that they share"):
            verify(store, threads=1, workers="tcp://elsewhere:8786")

    def test_an_archive(self, store, tmp_path):
        archive(store, tmp_path / "copy.zarr", level=1, threads=1)
        with pytest.raises(StoreMismatch, match=r"an archive.*stages.archive --restore"):
            verify(tmp_path / "copy.zarr", threads=1)

    def test_another_store_in_its_place_meanwhile(self, store, monkeypatch):
        def replaced(root, specs):
            store.rename(store.with_name("before.zarr"))
            shutil.copytree(store.with_name("before.zarr"), store)
            return []

        monkeypatch.setattr("pipeline.store.integrity.verification.strange_files", replaced)
        with pytest.raises(StoreMismatch, match="another store took its place"):
            verify(store, threads=1)
