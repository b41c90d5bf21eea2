"""Golden rows in a store: read back, proven, named where damaged, carried by merge and archive."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zarr

from pipeline.base.errors import StoreIncomplete
from pipeline.base.provenance import MOST_GOLDEN, row_key, spread
from pipeline.store import FeatureStore, StoreBuild
from pipeline.store.archive import archive, restore
from pipeline.store.chunks import write_seal
from pipeline.store.golden_rows import GOLDEN, GoldenFrames
from pipeline.store.merging import merge
from pipeline.store.schema import read_specs
from pipeline.store.verification import verify
from tests.store.samples import content, edit, flip


@pytest.fixture
def store(tiny_golden: Callable[..., Path], tmp_path: Path) -> Path:
    return tiny_golden(tmp_path)


class TestSound:
    def test_a_row_comes_back_with_its_features_and_proves_its_key(self, store):
        opened = FeatureStore.open(store)
        assert len(opened.golden) == 2
        for row, golden in zip((0, 7), opened.golden, strict=True):
            assert golden.key == opened.array("vl/key")[row].tobytes()
            assert golden.key == row_key("tiny-spec", ["View1"], golden.prompt, golden.frames)
            assert golden.instruction == "touch the dot"
            assert np.array_equal(golden.features, opened.array("vl/features")[row])
            assert golden.slot_valid.all()
        frame = zarr.open_group(store, mode="r")["golden/1/View1"][:]
        assert frame.shape == (6, 8, 3)
        assert np.array_equal(frame, opened.golden[1].frames["View1"])
        checked = verify(store)
        assert checked.sound, checked.lines()

    def test_features_are_those_of_the_plain_frames_in_float32(self, tiny_golden, tmp_path):
        opened = FeatureStore.open(tiny_golden(tmp_path, dtype="bfloat16"))
        (golden, _), bits = opened.golden, opened.array("vl/features")[0]
        assert golden.features.dtype == np.float32
        assert np.array_equal((golden.features.view(np.uint32) >> 16).astype(np.uint16), bits)

    def test_a_black_frame_is_kept_too(self, store):
        black = GoldenFrames(0, "p", {"View1": np.zeros((4, 4, 3), np.uint8)})
        build = StoreBuild(store.with_name("copy.zarr"), read_specs(store), "plan")
        shutil.copytree(store, build.part)
        build.write_golden([black])  # which is no frame of that row, and so left out
        assert zarr.open_group(build.part, mode="r").attrs[GOLDEN] == []
        build.files("vl/key").write(
            0, np.frombuffer(black.key({"digest": "tiny-spec", "views": ["View1"]}), "u1")[None]
        )
        assert build.write_golden([black]) == 0
        assert (build.part / "golden/0/View1/c/0/0/0").exists()
        build.close()


def forge_prompt(store: Path) -> None:
    attributes = zarr.open_group(store, mode="r+").attrs
    attributes[GOLDEN] = [entry | {"prompt": "other"} for entry in attributes[GOLDEN]]
    write_seal(store)


class TestDamage:
    @pytest.mark.parametrize(
        ("harm", "message"),
        [
            (
                lambda store: flip(store / "golden/1/View1/c/0/0/0", 3, 6),
                "golden/1/View1/c/0/0/0: golden frame cannot be read",
            ),
            (
                lambda store: edit(store / "golden/1/View1/zarr.json", dict.clear),
                "golden/1/View1/zarr.json: shape: missing",
            ),
            (
                lambda store: (store / "golden/0/View1/c/0/0/0").unlink(),
                "golden/0/View1/c/0/0/0: no such file",
            ),
            (forge_prompt, "golden/0: golden frames and prompt of VL row 0 do not give the"),
        ],
    )
    def test_is_named_by_all_that_read_them(self, tiny_golden, store, tmp_path, harm, message):
        harm(store)
        checked = verify(store)
        assert message in checked.lines()[0]
        assert len(checked.issues) == 1
        with pytest.raises(StoreIncomplete, match="golden"):
            _ = FeatureStore.open(store).golden
        with pytest.raises(StoreIncomplete, match="golden"):
            archive(store, store.with_name("copy.archive.zarr"), 1, 1)
        with pytest.raises(StoreIncomplete, match="golden"):
            merge([store, tiny_golden(tmp_path, name="other", seed=4)], tmp_path / "both.zarr")


class TestOtherStores:
    def test_an_archive_gives_them_back_to_the_byte(self, store, tmp_path):
        archive(store, tmp_path / "a.archive.zarr", 1, 1)
        assert np.array_equal(
            zarr.open_group(tmp_path / "a.archive.zarr", mode="r")["golden/0/View1"][:],
            FeatureStore.open(store).golden[0].frames["View1"],
        )
        restore(tmp_path / "a.archive.zarr", tmp_path / "back.zarr", 1)
        assert content(tmp_path / "back.zarr") == content(store)
        assert archive(store, tmp_path / "a.archive.zarr", 1, 1) is None, "it is there already"

    def test_a_damaged_golden_row_of_an_archive_is_named(self, store, tmp_path):
        archive(store, tmp_path / "a.archive.zarr", 1, 1)
        (tmp_path / "a.archive.zarr/golden/0/View1/c/0/0/0").write_bytes(b"other")
        with pytest.raises(StoreIncomplete, match=r"archive is damaged: .*golden frame"):
            restore(tmp_path / "a.archive.zarr", tmp_path / "back.zarr", 1)
        assert not list(tmp_path.glob("back.zarr*/"))

    def test_a_merge_takes_some_of_all(self, tiny_golden, tmp_path):
        inputs = [
            tiny_golden(tmp_path, name="a", seed=1, rows=(1, 20, 40, 59)),
            tiny_golden(tmp_path, name="b", seed=2, rows=(5, 50)),
        ]
        merge(inputs, tmp_path / "both.zarr")
        merged = FeatureStore.open(tmp_path / "both.zarr")
        assert [entry["row"] for entry in merged.attrs[GOLDEN]] == [1, 40, 59, 110]
        assert verify(merged.path).sound
        before = FeatureStore.open(inputs[1]).golden[1]
        after = merged.golden[3]
        assert after.key == before.key
        assert np.array_equal(after.features, before.features)


def test_rows_are_spread_over_those_with_the_most_views():
    views = np.array([1] * 5 + [2] * 9)
    chosen = spread(np.arange(14), views)
    assert chosen.tolist() == [5, 8, 10, 13]
    assert len(chosen) == MOST_GOLDEN
    assert spread(np.arange(2), np.array([3, 3])).tolist() == [0, 1]
    assert spread(np.arange(0), np.zeros(0, np.int64)).tolist() == []
