"""Everything that is wrong with a store is named, and a sound store passes."""

import errno
import json
import os
import shutil
from io import FileIO
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.base.errors import StoreIncomplete, StoreMismatch
from pipeline.base.text import size
from pipeline.store import FeatureStore, check_trailers
from pipeline.store.verification import verify
from tests.store.samples import chunk_file, content, edit, flip, put

ROWS = 60
ROW_BYTES = 3 * 8 * 4


@pytest.fixture
def store(tiny_store, tmp_path) -> Path:
    return tiny_store(tmp_path)


def faults(store: Path) -> list[str]:
    before = content(store)
    issues = list(verify(store).issues)
    assert content(store) == before, "a check writes nothing"
    return issues


class TestSound:
    @pytest.mark.parametrize(
        "changed", [{"dtype": "bfloat16"}, {"sensor_channels": 0, "state_dim": 0}]
    )
    def test_nothing_is_wrong(self, tiny_store, tmp_path, changed):
        verification = verify(tiny_store(tmp_path, **changed))
        assert verification.lines() == []
        assert verification.sound

    def test_says_how_much_was_read(self, store):
        verification = verify(store)
        arrays = [path for path in store.rglob("c/**/*") if path.is_file()]
        assert verification.bytes == sum(path.stat().st_size - 4 for path in arrays)
        assert f"{size(verification.bytes)} of files" in verification.summary()
        assert verification.rows == ROWS

    def test_over_several_chunks_and_blocks(self, tiny_store, tmp_path, monkeypatch):
        monkeypatch.setattr("pipeline.store.schema.CHUNK_BYTES", 4096)
        monkeypatch.setattr("pipeline.store.chunks.BLOCK_BYTES", 10_000)
        store = tiny_store(tmp_path, readings_a_tick=60)
        assert faults(store) == []
        flip(chunk_file(store, "sensor/values", 1), 77)
        (issue,) = faults(store)
        assert issue.startswith(f"{chunk_file(store, 'sensor/values', 1)}: expected the crc32c")


class TestFeatureRows:
    def test_a_flipped_bit_names_file_and_row(self, store):
        flip(chunk_file(store, "vl/features"), 17 * ROW_BYTES + 5, bit=6)
        (issue,) = faults(store)
        assert issue.startswith(f"{chunk_file(store, 'vl/features')}: expected the crc32c")
        assert issue.endswith("; row 17 of vl/features does not give its checksum")

    @pytest.mark.parametrize(("array", "value"), [("vl/features", 1.0), ("vl/checksum", 0)])
    def test_a_row_that_another_program_wrote(self, store, array, value):
        put(store, array, slice(3, 5), value)
        (issue,) = faults(store)
        expected = "2 rows from 3 to 4 of vl/features do not give their checksums"
        assert issue == f"{chunk_file(store, 'vl/features')}: {expected}"
        with pytest.raises(StoreIncomplete, match=expected):
            check_trailers(store)

    def test_a_truncated_file(self, store):
        os.truncate(chunk_file(store, "vl/features"), 50 * ROW_BYTES + 10)
        (issue,) = faults(store)
        assert issue.endswith("expected 196612 bytes, found 4810")

    def test_a_disk_that_fails(self, store, monkeypatch):
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
        (issue,) = verify(store).issues
        assert "cannot be read at byte 4800: Input/output error" in issue

    def test_rows_are_good_where_the_file_of_checksums_is_lost(self, store):
        chunk_file(store, "vl/checksum").unlink()
        (issue,) = faults(store)
        what = "cannot be read at byte 0: No such file or directory"
        assert issue == f"{chunk_file(store, 'vl/checksum')}: {what}"


class TestSeal:
    """A chunk that is sound by itself and lies in another's place, as after a botched copy."""

    def exchange(self, store: Path, other: Path) -> str:
        first, second = (chunk_file(store, "sensor/values", chunk) for chunk in (0, 1))
        kept = first.read_bytes()
        first.write_bytes(second.read_bytes())
        second.write_bytes(kept)
        return "sensor/values"

    def other_features(self, store: Path, other: Path) -> str:
        """Rows of another prompt, with their checksums."""
        for array in ("vl/checksum", "vl/features"):
            shutil.copy(chunk_file(other, array), chunk_file(store, array))
        return "vl/features"

    @pytest.mark.parametrize("harm", [exchange, other_features])
    def test_a_chunk_in_another_place(self, tiny_store, tmp_path, monkeypatch, harm):
        monkeypatch.setattr("pipeline.store.schema.CHUNK_BYTES", 4096)
        store = tiny_store(tmp_path, ticks=1500)
        array = harm(self, store, tiny_store(tmp_path, name="other", seed=7, ticks=1500))
        assert any(array in issue and "sealed for this place" in issue for issue in faults(store))
        for read in (FeatureStore.open, check_trailers):
            with pytest.raises(StoreIncomplete, match=r"sealed for this place.*verify --repair"):
                read(store)


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_flipped_bit_of_any_chunk_is_named(tiny_store, tmp_path_factory, data):
    store = tiny_store(tmp_path_factory.mktemp("flip"))
    files = sorted(path for path in store.rglob("c/**/*") if path.is_file())
    path = data.draw(st.sampled_from(files))
    flip(path, data.draw(st.integers(0, path.stat().st_size - 1)), data.draw(st.integers(0, 7)))
    named = {issue.split(": ")[0] for issue in verify(store).issues}
    rows = {str(chunk_file(store, "vl/features"))} if "vl/checksum" in str(path) else set()
    assert str(path) in named <= {str(path)} | rows


class TestStructure:
    @pytest.mark.parametrize(
        ("place", "change", "message"),
        [
            ("zarr.json", lambda at: at.pop("sources"), "sources: missing"),
            ("zarr.json", lambda at: at.update(action_hz=30.0), "were changed"),
            ("vl/zarr.json", lambda at: at["slots"][0].update(pooling="last"), "were changed"),
            ("sensor/values/zarr.json", lambda at: at.update(note="mine"), "attributes.note"),
        ],
    )
    def test_changed_attributes(self, store, place, change, message):
        edit(store / place, lambda document: change(document["attributes"]))
        (issue,) = faults(store)
        assert message in issue
        assert "--repair" not in issue, "once is enough, after the last"
        with pytest.raises(StoreIncomplete, match=rf"{message}.*verify.store={store}"):
            FeatureStore.open(store)

    @pytest.mark.parametrize("lost", ["metadata_digest", "seal"])
    def test_metadata_without_a_digest_prove_nothing(self, store, lost):
        edit(store / "zarr.json", lambda document: document["attributes"].update(action_hz=30.0))
        edit(store / "zarr.json", lambda document: document["attributes"].pop(lost))
        assert faults(store)
        with pytest.raises(StoreIncomplete, match=r"zarr\.json: .*verify --repair"):
            FeatureStore.open(store)

    def test_a_store_that_no_longer_says_what_it_is(self, store):
        document = json.loads((store / "zarr.json").read_text())
        del document["attributes"]["plan"]
        for text in (json.dumps(document), "{"):
            (store / "zarr.json").write_text(text)
            with pytest.raises(StoreIncomplete, match=r"Nothing can be taken.*archive --restore"):
                verify(store)


def test_what_is_no_finished_store(store):
    edit(store / "zarr.json", lambda document: document["attributes"].update(schema=3))
    with pytest.raises(StoreMismatch, match="expected store schema 1 or 2, found 3"):
        verify(store)
    part = store.rename(store.with_name("tiny.zarr.part"))
    for path in (store, part):
        with pytest.raises(StoreIncomplete, match="only the unfinished build"):
            verify(path)
