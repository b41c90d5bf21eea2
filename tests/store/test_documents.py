"""A store may come from anywhere: what is wrong with it is refused with file, place and remedy."""

import json
import os
import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import pytest

from pipeline.base.errors import PipelineError, StoreIncomplete
from pipeline.store import FeatureStore, RowSource, part_path
from pipeline.store.archive import archive, restore
from pipeline.store.chunks import note_metadata
from pipeline.store.documents import mend, start_over
from pipeline.store.verification import verify
from tests.store.samples import edit, put

DEEP = "[" * 100_000 + "]" * 100_000
Harm = Callable[[Path], object]


@pytest.fixture(scope="module")
def original(tiny_golden, tmp_path_factory) -> Path:
    store = tiny_golden(tmp_path_factory.mktemp("original"))
    archive(store, store.with_name("tiny.archive.zarr"), 1, 1)
    return store


@pytest.fixture
def store(original, tmp_path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "tiny.zarr"))


@pytest.fixture
def archived(original, tmp_path) -> Path:
    source = original.with_name("tiny.archive.zarr")
    return Path(shutil.copytree(source, tmp_path / "tiny.archive.zarr"))


def text(place: str, content: str | bytes) -> Harm:
    raw = content if isinstance(content, bytes) else content.encode()
    return lambda root: Path(root, place, "zarr.json").write_bytes(raw)


def changed(text: str, dotted: str, value: str) -> str:
    """A JSON document whose entry, named by dots, is this JSON."""
    document: Any = json.loads(text)
    at, *keys = document, *dotted.split(".")
    for key in keys[:-1]:
        at = at[int(key) if key.isdigit() else key]
    at[keys[-1]] = "@"
    return json.dumps(document).replace('"@"', value, 1)


def entry(folder: str, dotted: str, value: str) -> Harm:
    """Another entry in a `zarr.json`."""

    def harm(root: Path) -> None:
        path = root / folder / "zarr.json"
        path.write_text(changed(path.read_text(), dotted, value))

    return harm


def values(array: str, row: int | slice, value: object) -> Harm:
    """Another row of an array, sealed."""
    return partial(put, array=array, row=row, value=value)


def instead(name: str, make: Callable[[Path], object]) -> Harm:
    """Something else in place of a file."""

    def harm(root: Path) -> None:
        (root / name).unlink()
        make(root / name)

    return harm


def without_end(path: Path) -> None:
    """A document that nobody may wait for."""
    path.symlink_to("/dev/zero")


ROOT = {
    "schema": ["null", "1" + "0" * 400],
    "plan": ['"' + "x" * 20_000 + '"'],
    "feature_spec": ['{"digest": "x"}'],
    "feature_spec.views": ['["../x"]'],
    "feature_spec.slots": ["[1]", "[]"],
    "feature_spec.variants": ["10000000000"],
    "feature_spec.dim": ["7"],
    "streams": ["{}"],
    "streams.sensor.names": ['["a"]'],
    "streams.views": ['["View1", "View2"]'],
    "sources": ["[]"],
    "action_hz": ["0", "NaN"],
    "vlm_reuse_count": ["3.5"],
    "environment": ['[{"rows": [0, 1' + "0" * 300 + "]}]"],
    "golden": ['[{"row": 60, "prompt": "", "views": []}]'],
    "golden.0.views": ['["../../x"]'],
    "golden.0.prompt": ['"' + "x" * 2_000_000 + '"'],
    "note": [DEEP, '"\\ud800"'],
}
ARRAY = {
    "shape": ["[1000000000000]", "[9223372036854775808]", "[-1]", "[179]", "[180, 1]"],
    "data_type": ['"float32"', '{"name": "float64"}'],
    "dimension_names": ["null"],
    "fill_value": ["1"],
    "codecs": ['[{"name": "bytes"}, {"name": "zstd"}, {"name": "crc32c"}]'],
    "codecs.0.configuration.endian": ['"big"'],
    "chunk_key_encoding.configuration.separator": ['"."'],
    "chunk_grid.configuration.chunk_shape": ["[100]", "[]", "[4096000000000]"],
}
HARMS: list[tuple[Harm, str]] = [
    *(
        (entry("", f"attributes.{key}", value), "zarr.json: ")
        for key, several in ROOT.items()
        for value in several
    ),
    *(
        (entry("tick/time", key, value), "tick/time/zarr.json: ")
        for key, several in ARRAY.items()
        for value in several
    ),
    (text("", DEEP), "zarr.json: "),
    (text("", b"\xff{}"), "zarr.json: "),
    (text("", "null"), "zarr.json: "),
    (instead("zarr.json", os.mkfifo), "zarr.json: "),
    (instead("vl/zarr.json", without_end), "vl/zarr.json: "),
    (instead("tick/time/zarr.json", without_end), "tick/time/zarr.json: "),
    (instead("vl/features/c/0/0/0", Path.mkdir), "vl/features/c/0/0/0: "),
    (instead("tick/time/c/0", os.mkfifo), "tick/time/c/0: "),
    *(
        (
            values(f"episode/{stream}_start", row, value),
            f"episode/{stream}_start: expected offsets that rise from 0 to ",
        )
        for stream, row, value in (("tick", 0, 1), ("text", 6, 10**6), ("vl", 3, 2**62))
    ),
    *(
        (values(array, 100, value), f"{array}: expected positions from ")
        for array, value in (
            ("tick/vl_row", -1),
            ("tick/sensor_end", 10**12),
            ("tick/state_end", -(2**63)),
        )
    ),
    (values("episode/source", 2, -1), "episode/source: expected"),
    (values("episode/source", 2, 2), "episode/source: expected"),
    (values("episode/text", slice(0, 3), 255), "episode/text, episode 0: "),
    (values("episode/text", slice(0, 120), ord("[")), "episode/text, episode 0: "),
]


class TestStores:
    @pytest.mark.timeout(20)
    @pytest.mark.parametrize(("harm", "place"), HARMS)
    def test_a_broken_one_is_refused_with_place_and_remedy(self, store, harm, place):
        harm(store)
        with pytest.raises(PipelineError) as caught:
            opened = FeatureStore.open(store)
            opened.gather(range(0, opened.ticks, 7))
            _ = opened.episodes, opened.golden
        message = str(caught.value)
        assert f"{store}/{place}" in message
        assert re.search(r"Run python -m stages|run python -m stages|Extract it again", message)
        assert len(message) < 2000
        try:
            checked = verify(store)
        except PipelineError as error:
            assert str(store) in str(error)
        else:
            assert all(str(store) in issue for issue in checked.issues)
            assert not checked.sound

    def test_all_tell_the_same_lie(self, store):
        for path in store.glob("tick/*/zarr.json"):
            edit(path, lambda document: document["shape"].__setitem__(0, 10**12))
        note_metadata(store)
        for work in (FeatureStore.open, RowSource, verify):
            with pytest.raises(StoreIncomplete, match=r"expected [\d,]+ chunk files by the shape"):
                if (checked := work(store)) and hasattr(checked, "lines"):
                    raise StoreIncomplete("\n".join(checked.lines()))

    @pytest.mark.parametrize(
        "harm", [text("tick/time", DEEP), values("episode/vl_start", 3, 2**62)]
    )
    def test_a_build_is_not_trusted_either(self, store, harm):
        harm(store)
        part = store.rename(part_path(store))
        with pytest.raises(StoreIncomplete, match=rf"{part}/.*Remove it with .*store gc"):
            _ = RowSource(part).texts

    def test_a_frame_that_unpacks_to_more_than_it_is(self, store):
        blocks = b"".join((2**20 | 2 | last).to_bytes(3, "little") + b"7" for last in [0] * 9 + [1])
        packed = b"\x28\xb5\x2f\xfd\x00\x38" + blocks
        path = store / "golden/0/View1/c/0/0/0"
        path.write_bytes(packed + google_crc32c.value(packed).to_bytes(4, "little"))
        with pytest.raises(StoreIncomplete, match=rf"{path}: golden frame cannot be read"):
            _ = FeatureStore.open(store).golden

    @pytest.mark.parametrize("make", [Path.touch, os.mkfifo, lambda at: at.symlink_to("/nowhere")])
    def test_no_folder_at_all(self, tmp_path, make):
        make(tmp_path / "s.zarr")
        with pytest.raises(StoreIncomplete, match=r"s\.zarr: no finished store, found"):
            FeatureStore.open(tmp_path / "s.zarr")


def manifest(change: Callable[[dict[str, Any]], object]) -> Harm:
    """Another manifest."""
    return lambda root: edit(
        root / "zarr.json", lambda document: change(document["attributes"]["archive"])
    )


def of_store(name: str, dotted: str, value: str) -> Harm:
    """Another entry in one of the texts that the manifest holds."""

    def change(entries: dict[str, Any]) -> None:
        entries["metadata"][name] = changed(entries["metadata"][name], dotted, value)

    return manifest(change)


ARCHIVES: dict[str, Harm] = {
    "frame outside": of_store("zarr.json", "attributes.golden.0.views", '["../../x"]'),
    "no text": manifest(lambda it: it["metadata"].pop("zarr.json")),
    "text": manifest(lambda it: it["metadata"].update({"tick/time/zarr.json": DEEP})),
    "rows": of_store("tick/time/zarr.json", "shape", "[1000000000000]"),
    "chunks": of_store("tick/time/zarr.json", "chunk_grid.configuration.chunk_shape", "[8192000]"),
    "forged": of_store("zarr.json", "attributes.action_hz", "30.0"),
    "unsealed": of_store("zarr.json", "attributes.seal", "{}"),
    "root": text("", DEEP),
    "pipe": instead("tick/time/c/0", os.mkfifo),
    "terabyte": lambda root: os.truncate(root / "tick/time/c/0", 2**40),
    "device": instead("golden/0/View1/c/0/0/0", without_end),
}


class TestArchives:
    @pytest.mark.timeout(20)
    @pytest.mark.parametrize("harm", ARCHIVES.values(), ids=ARCHIVES)
    def test_a_broken_one_restores_nothing(self, archived, tmp_path, harm):
        harm(archived)
        before = sorted(tmp_path.iterdir())
        with pytest.raises(PipelineError) as caught:
            restore(archived, tmp_path / "back.zarr", threads=1)
        assert str(archived) in str(caught.value)
        assert "take another copy" in str(caught.value) or "Remove or rename" in str(caught.value)
        assert set(tmp_path.iterdir()) - {*before} <= {tmp_path / "back.zarr.lock"}

    def test_a_piece_that_unpacks_to_more_than_it_is(self, archived, tmp_path):
        shard = archived / "tick/time/c/0"
        content = bytearray(shard.read_bytes())
        begin, length = np.frombuffer(content[-20:-4], "<u8").tolist()
        content[begin + 4 : begin + 8] = (2**31 - 32).to_bytes(4, "little")
        piece = bytes(content[begin : begin + length - 4])
        checksum = google_crc32c.value(piece).to_bytes(4, "little")
        content[begin + length - 4 : begin + length] = checksum
        shard.write_bytes(content)
        with pytest.raises(StoreIncomplete, match=rf"{shard}: .*a piece is not \d+ bytes"):
            restore(archived, tmp_path / "back.zarr", threads=1)


class TestRemedies:
    """The command that a message advises acts on the damaged store itself."""

    @pytest.mark.parametrize("inside", ["", "vl/features/c/0/0/0"])
    def test_a_store_is_repaired_and_extracted_by_name(self, inside):
        advice = mend(Path("some/my store.zarr") / inside)
        assert "stages.verify --repair --set 'verify.store=some/my store.zarr'" in advice
        assert "stages.extract" not in advice, "params may describe another store than this"
        assert ".part" not in advice

    def test_a_build_is_removed_and_begun_anew(self):
        advice = mend(Path("some/a.zarr.part/vl/key/c/0/0"))
        assert "python -m stages.store gc some/a.zarr.part --remove" in advice
        assert advice.endswith("python -m stages.extract --set extract.store=some/a.zarr.")
        assert "--repair" not in advice
        assert start_over(Path("some/a.zarr.part")) == advice, "the same where its root is lost"
