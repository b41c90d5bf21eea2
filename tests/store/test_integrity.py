"""Everything that is wrong with a store is named, and a sound store passes."""

import errno
import json
import os
import shutil
from dataclasses import replace
from io import FileIO
from pathlib import Path

import distributed
import google_crc32c
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.base.errors import StoreIncomplete, StoreMismatch
from pipeline.base.text import MOST_LINES, size
from pipeline.store import FeatureStore, check_trailers
from pipeline.store.archive import archive
from pipeline.store.schema import read_spec
from pipeline.store.verification import Verification, verify
from tests.store.samples import chunk_file, content, edit, flip, put

ROWS = 60
ROW_BYTES = 3 * 8 * 4


@pytest.fixture(scope="module")
def original(tiny_store, tmp_path_factory) -> Path:
    return tiny_store(tmp_path_factory.mktemp("original"))


@pytest.fixture
def store(original, tmp_path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "tiny.zarr"))


def put_nan(store: Path, row: int) -> None:
    """NaN in a whole row, with right checksums."""
    put(store, "vl/features", row, np.nan)
    spec = read_spec(store, "vl/features")
    values = np.full(spec.shape[1:], np.nan, spec.dtype)
    put(store, "vl/checksum", row, google_crc32c.value(values.tobytes()))


def checked(store: Path) -> Verification:
    before = content(store)
    verification = verify(store, threads=2)
    assert content(store) == before, "a check writes nothing"
    return verification


def damaged_arrays(verification: Verification) -> set[str]:
    return {issue.stream for issue in verification.damaged}


class TestSound:
    @pytest.mark.parametrize(
        "changed",
        [
            {"dtype": "float16"},
            {"dtype": "bfloat16"},
            {"sensor_channels": 0, "state_dim": 0},
            {"ticks": 31, "episodes": 1},
        ],
    )
    def test_nothing_is_wrong(self, tiny_store, tmp_path, changed):
        verification = checked(tiny_store(tmp_path, **changed))
        assert verification.lines() == []
        assert verification.sound

    def test_every_byte_is_read(self, store):
        verification = checked(store)
        files = [path for path in store.rglob("*") if path.is_file() and path.name != "zarr.json"]
        assert verification.bytes == sum(path.stat().st_size for path in files)
        assert f"{size(verification.bytes)} of files" in verification.summary()
        assert verification.rows == ROWS

    def test_over_several_chunks_and_blocks(self, tiny_store, tmp_path, monkeypatch):
        monkeypatch.setattr("pipeline.store.schema.CHUNK_BYTES", 4096)
        monkeypatch.setattr("pipeline.store.chunks.BLOCK_BYTES", 10_000)
        store = tiny_store(tmp_path, readings_a_tick=60)
        assert checked(store).sound
        flip(chunk_file(store, "sensor/values", 1), 77)
        (issue,) = checked(store).damaged
        assert (issue.stream, issue.chunk) == ("sensor/values", 1)
        assert "rows 4096 to 8191" in issue.message
        assert "left/episode_002, sensor reading 496" in issue.message
        assert "left/episode_004, sensor reading 991" in issue.message

    @pytest.mark.slow
    def test_workers_find_what_threads_find_and_nobody_else_reaches_them(self, store, monkeypatch):
        addresses = []

        class Noting(distributed.Client):
            def __init__(self, *where, **settings):
                super().__init__(*where, **settings)
                addresses.append(self.scheduler.address)

        monkeypatch.setattr("distributed.Client", Noting)
        flip(chunk_file(store, "vl/features"), 17 * ROW_BYTES)
        flip(chunk_file(store, "tick/vl_row"), 31)
        here, there = verify(store, threads=2), verify(store, threads=1, workers=2)
        assert there.lines() == here.lines()
        assert here.bad_rows.tolist() == [17]
        assert addresses and all(address.startswith("tls://") for address in addresses)


class TestFeatureRows:
    def test_a_flipped_bit_names_row_episode_and_tick(self, store):
        flip(chunk_file(store, "vl/features"), 17 * ROW_BYTES + 5, bit=6)
        verification = checked(store)
        assert verification.bad_rows.tolist() == [17]
        damaged = [(issue.stream, issue.chunk) for issue in verification.damaged]
        assert damaged == [("vl/features", 0)]
        file, row = verification.lines()
        assert str(chunk_file(store, "vl/features")) in file
        assert row.startswith("VL row 17: its bytes do not give its checksum")
        assert "right/episode_001, VL row 7" in row

    @pytest.mark.parametrize(("array", "value"), [("vl/features", 1.0), ("vl/checksum", 0)])
    def test_a_row_that_another_program_wrote(self, store, array, value):
        put(store, array, 3, value)
        verification = checked(store)
        assert verification.bad_rows.tolist() == [3]
        assert "do not give its checksum" in verification.lines()[0]
        assert not verification.damaged, "the file is as it was written"
        with pytest.raises(StoreIncomplete, match="rows 3 to 3 of vl/features do not give their"):
            check_trailers(store)

    def test_a_nan_is_named_unless_its_slot_is_of_a_missing_view(self, store):
        put_nan(store, 22)
        verification = checked(store)
        assert verification.bad_rows.tolist() == [22]
        (line,) = verification.lines()
        assert line.startswith("VL row 22: NaN or infinity; left/episode_002, VL row 2")
        put(store, "vl/slot_valid", 22, 0)
        assert checked(store).sound
        chunk_file(store, "vl/slot_valid").unlink()
        verification = checked(store)
        assert verification.bad_rows.tolist() == [22]
        assert damaged_arrays(verification) == {"vl/slot_valid"}

    @pytest.mark.parametrize(("dtype", "bits"), [("float16", 0x7C00), ("bfloat16", 0xFF80)])
    def test_infinities_of_narrow_dtypes(self, tiny_store, tmp_path, dtype, bits):
        store = tiny_store(tmp_path, dtype=dtype)
        stored = FeatureStore.open(store).array("vl/features")[5].copy()
        stored.view(np.uint16)[1, 2] = bits
        put(store, "vl/features", 5, stored)
        put(store, "vl/checksum", 5, google_crc32c.value(stored.tobytes()))
        assert checked(store).bad_rows.tolist() == [5]
        assert "NaN or infinity" in checked(store).lines()[0]

    def test_rows_after_the_end_of_a_truncated_file(self, store):
        os.truncate(chunk_file(store, "vl/features"), 50 * ROW_BYTES + 10)
        verification = checked(store)
        assert verification.bad_rows.tolist() == list(range(50, ROWS))
        assert verification.rows == 50
        assert "expected 196612 bytes, found 4810" in verification.lines()[0]
        assert all("not in its file" in line for line in verification.lines()[1:])

    def test_a_missing_file(self, store):
        chunk_file(store, "vl/features").unlink()
        verification = checked(store)
        assert verification.bad_rows.tolist() == list(range(ROWS))
        assert "cannot be read at byte 0: No such file or directory" in verification.lines()[0]
        assert verification.rows == 0
        assert "VL rows 0 to 59: not in its file" in verification.lines()[1]

    def test_many_runs_of_rows_are_capped(self, store):
        put(store, "vl/features", slice(0, ROWS, 2), 1.0)
        lines = checked(store).lines()
        assert len(lines) == MOST_LINES + 1
        assert lines[-1].startswith("and 10 more")

    def test_rows_on_a_disk_that_fails(self, store, monkeypatch):
        monkeypatch.setattr("pipeline.store.chunks.BLOCK_BYTES", 10 * ROW_BYTES)
        path, opened = chunk_file(store, "vl/features"), Path.open

        class Failing(FileIO):
            def readinto(self, buffer):
                if self.tell() >= 50 * ROW_BYTES:
                    raise OSError(errno.EIO, "Input/output error")
                return super().readinto(buffer)

        def failing(self, *args, **kwargs):
            return Failing(self) if self == path else opened(self, *args, **kwargs)

        monkeypatch.setattr(Path, "open", failing)
        verification = verify(store, threads=1)
        assert verification.bad_rows.tolist() == list(range(50, ROWS))
        assert "cannot be read at byte 4800: Input/output error" in verification.lines()[0]

    @pytest.mark.parametrize("harm", [Path.unlink, lambda path: flip(path, 4 * 11)])
    def test_rows_are_good_where_only_their_checksums_are_lost(self, store, harm):
        harm(chunk_file(store, "vl/checksum"))
        verification = checked(store)
        assert not len(verification.bad_rows)
        assert damaged_arrays(verification) == {"vl/checksum"}


class TestSeal:
    """A chunk that is sound by itself and lies in another's place, as after a botched copy."""

    @pytest.fixture
    def chunked(self, tiny_store, tmp_path, monkeypatch) -> Path:
        monkeypatch.setattr("pipeline.store.schema.CHUNK_BYTES", 4096)
        return tiny_store(tmp_path, ticks=1500)

    def exchange(self, store: Path, other: Path) -> str:
        first, second = (chunk_file(store, "sensor/values", chunk) for chunk in (0, 1))
        kept = first.read_bytes()
        first.write_bytes(second.read_bytes())
        second.write_bytes(kept)
        return "sensor/values"

    def older_actions(self, store: Path, other: Path) -> str:
        shutil.copy(chunk_file(other, "tick/action"), chunk_file(store, "tick/action"))
        return "tick/action"

    def other_features(self, store: Path, other: Path) -> str:
        """Rows of another prompt, with their checksums."""
        for array in ("vl/checksum", "vl/features"):
            shutil.copy(chunk_file(other, array), chunk_file(store, array))
        return "vl/features"

    @pytest.mark.parametrize("harm", [exchange, older_actions, other_features])
    def test_a_chunk_in_another_place(self, chunked, tiny_store, tmp_path, harm):
        array = harm(self, chunked, tiny_store(tmp_path, name="other", seed=7, ticks=1500))
        verification = checked(chunked)
        assert array in damaged_arrays(verification)
        assert any("sealed for this place" in line for line in verification.lines())
        assert (len(verification.bad_rows) > 0) == (array == "vl/features")
        for read in (FeatureStore.open, check_trailers):
            with pytest.raises(StoreIncomplete, match=r"sealed for this place.*verify --repair"):
                read(chunked)


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_flipped_bit_of_any_chunk_is_named(original, tmp_path_factory, data):
    store = Path(shutil.copytree(original, tmp_path_factory.mktemp("flip") / "tiny.zarr"))
    files = sorted(path for path in store.rglob("c/**/*") if path.is_file())
    path = data.draw(st.sampled_from(files))
    flip(path, data.draw(st.integers(0, path.stat().st_size - 1)), data.draw(st.integers(0, 7)))
    verification = verify(store, threads=1)
    array = path.relative_to(store).as_posix().split("/c/")[0]
    assert damaged_arrays(verification) == {array}
    assert {issue.file for issue in verification.damaged} == {path}


class TestStructure:
    @pytest.mark.timeout(20)
    @pytest.mark.parametrize("document", ["vl/zarr.json", "vl/key/zarr.json"])
    def test_a_document_without_an_end_is_never_waited_for(self, store, document):
        (store / document).unlink()
        (store / document).symlink_to("/dev/zero")
        assert any(f"{store / document}: " in line for line in checked(store).lines())

    @pytest.mark.parametrize(
        ("place", "change", "message"),
        [
            ("zarr.json", lambda at: at.pop("sources"), "sources: missing"),
            ("zarr.json", lambda at: at["streams"]["action"]["names"].pop(), "4 names, but 5"),
            ("zarr.json", lambda at: at.update(action_hz=30.0), "were changed"),
            ("vl/zarr.json", lambda at: at["slots"][0].update(pooling="last"), "were changed"),
            ("sensor/values/zarr.json", lambda at: at.update(note="mine"), "attributes.note"),
        ],
    )
    def test_changed_attributes(self, store, place, change, message):
        edit(store / place, lambda document: change(document["attributes"]))
        verification = checked(store)
        assert damaged_arrays(verification) == {place.removesuffix("zarr.json").rstrip("/")} or (
            damaged_arrays(verification) == {""}
        )
        assert any(message in line for line in verification.lines()), verification.lines()
        with pytest.raises(StoreIncomplete, match=rf"{message}.*verify.store={store}"):
            FeatureStore.open(store)

    @pytest.mark.parametrize("lost", ["metadata_digest", "seal"])
    def test_metadata_without_a_digest_prove_nothing(self, store, lost):
        edit(store / "zarr.json", lambda document: document["attributes"].update(action_hz=30.0))
        edit(store / "zarr.json", lambda document: document["attributes"].pop(lost))
        assert damaged_arrays(checked(store)) == {""}
        with pytest.raises(StoreIncomplete, match=r"zarr\.json: .*verify --repair"):
            FeatureStore.open(store)

    def test_a_store_that_no_longer_says_what_it_is(self, store):
        document = json.loads((store / "zarr.json").read_text())
        del document["attributes"]["plan"]
        for text, message in (
            (json.dumps(document), "no longer say what the store was made of"),
            ("{", "cannot be read as JSON"),
        ):
            (store / "zarr.json").write_text(text)
            with pytest.raises(StoreIncomplete, match=f"{message}.*--repair cannot") as caught:
                verify(store, threads=1)
            assert "stages.archive --restore" in str(caught.value)

    def test_files_that_have_no_place(self, store):
        (store / "tick" / "notes.txt").touch()
        (store / ".environments.json").touch()
        verification = checked(store)
        assert [line.split(": ")[0] for line in verification.lines()] == [
            str(store / ".environments.json"),
            str(store / "tick" / "notes.txt"),
        ]
        assert all("remove it" in line for line in verification.lines())


class TestOtherThings:
    def test_what_is_no_finished_store(self, store, tmp_path, monkeypatch):
        archive(store, tmp_path / "copy.zarr", level=1, threads=1)
        edit(store / "zarr.json", lambda document: document["attributes"].update(schema=3))
        with pytest.raises(StoreMismatch, match="expected store schema 1 or 2, found 3"):
            verify(store, threads=1)
        part = store.rename(store.with_name("tiny.zarr.part"))
        (tmp_path / "other" / "x").mkdir(parents=True)
        monkeypatch.setattr(os, "walk", lambda _: pytest.fail("walked"))
        for path, message in (
            (tmp_path / "no.zarr", "nothing there"),
            (tmp_path / "other", "no finished store"),
            (store, "only the unfinished build"),
            (part, "only the unfinished build"),
            (tmp_path / "copy.zarr", r"an archive.*stages.archive --restore"),
        ):
            with pytest.raises((StoreIncomplete, StoreMismatch), match=message):
                verify(path, threads=1)

    def test_workers_that_do_not_see_the_store(self, store, monkeypatch):
        def elsewhere(checks, workers):
            yield from (replace(check(), bytes=0, damage="no file") for check in checks)

        monkeypatch.setattr("pipeline.store.verification._run_on_cluster", elsewhere)
        with pytest.raises(StoreIncomplete, match="a file system that they share"):
            verify(store, threads=1, workers="tcp://elsewhere:8786")

    def test_another_store_in_its_place_meanwhile(self, store, monkeypatch):
        def replaced(root, specs, golden):
            store.rename(store.with_name("before.zarr"))
            shutil.copytree(store.with_name("before.zarr"), store)
            return []

        monkeypatch.setattr("pipeline.store.verification.strange_files", replaced)
        with pytest.raises(StoreMismatch, match="another store took its place"):
            verify(store, threads=1)
