"""Extraction keeps golden rows: fresh, resumed, taken over and repaired builds alike."""

import shutil

import numpy as np
import pytest
import zarr
from PIL import Image

from pipeline.base.config import Params
from pipeline.data.episode import RowRange
from pipeline.extract import extract
from pipeline.store import FeatureStore, StoreBuild
from pipeline.store.chunks import write_seal
from pipeline.store.golden_rows import GOLDEN
from pipeline.store.verification import verify
from pipeline.vlm.preparation import Preparer


def assert_golden(params: Params) -> FeatureStore:
    """The store has four golden rows of both views that give their keys, and is sound."""
    store = FeatureStore.open(params.extract.store)
    assert [[*golden.frames] for golden in store.golden] == [["View1", "View2"]] * 4
    rows = [entry["row"] for entry in store.attrs[GOLDEN]]
    full = np.flatnonzero(np.isfinite(store.array("vl/frame_time")).all(axis=1))
    assert (rows[0], rows[-1]) == (full[0], full[-1])
    checked = verify(store.path)
    assert checked.sound, checked.lines()
    return store


def forget_golden(params: Params) -> None:
    """The store is one of an earlier version."""
    shutil.rmtree(params.extract.store / GOLDEN)
    group = zarr.open_group(params.extract.store, mode="r+")
    del group.attrs[GOLDEN]
    write_seal(params.extract.store)


class TestBuilds:
    def test_a_fresh_build(self, params, extracted):
        store = assert_golden(params)
        preparer, golden = Preparer(params.vlm, _Views()), store.golden[0]
        row = store.attrs[GOLDEN][0]["row"]
        (episode,) = (episode for episode in store.episodes if row in episode.vl_rows)
        assert golden.instruction == episode.instruction
        assert golden.prompt == preparer.render(golden.instruction, [*golden.frames])
        names = [name for name, _ in zarr.open_group(store.path, mode="r").members(max_depth=None)]
        assert {f"golden/{n}/View{view}" for n in range(4) for view in (1, 2)} <= {*names}

    @pytest.mark.parametrize("carried", [True, False])
    def test_of_rows_that_are_taken_over_those_four_alone_are_decoded_and_only_once(
        self, params, changed, extracted, no_model, monkeypatch, carried
    ):
        """Where the store before has them, not even those."""
        if not carried:
            forget_golden(params)
        decoded: list[int] = []
        real = RowRange.read

        def read(self):
            decoded.extend(self.rows.tolist())
            return real(self)

        monkeypatch.setattr(RowRange, "read", read)
        report = extract(changed(extract={"sensor_dtype": "float16"}), print)
        assert report is not None and report.taken == report.rows
        store = assert_golden(params)
        assert decoded == ([] if carried else [entry["row"] for entry in store.attrs[GOLDEN]])

    def test_pixels_that_are_decoded_otherwise_today_are_left_out_and_said(
        self, params, changed, extracted, monkeypatch
    ):
        forget_golden(params)
        real = Image.Image.convert
        monkeypatch.setattr(
            Image.Image,
            "convert",
            lambda *args, **kw: real(*args, **kw).point(lambda value: min(255, value + 8)),
        )
        said: list[str] = []
        extract(changed(extract={"sensor_dtype": "float16"}), said.append)
        assert any(line.startswith("4 golden row(s) left out: decoded") for line in said)
        store = FeatureStore.open(params.extract.store)
        assert store.golden == ()
        assert store.attrs[GOLDEN] == []
        assert verify(store.path).sound


class TestKills:
    @pytest.mark.parametrize("frames", [3, 8])
    def test_a_kill_while_they_are_written(self, params, monkeypatch, no_model_later, frames):
        """With so many frames written; 8 is after the last, before sealing."""
        written = iter(range(100))

        from pipeline.store import golden_rows

        real = golden_rows._write_frame

        def killed(*args):
            if next(written) == frames:
                raise KeyboardInterrupt
            real(*args)

        def killed_before(*_, **__):
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(golden_rows, "_write_frame", killed)
            patch.setattr(StoreBuild, "seal", killed_before)
            with pytest.raises(KeyboardInterrupt):
                extract(params, print)
        assert not params.extract.store.exists()
        no_model_later()
        extract(params, print)
        assert_golden(params)


def test_a_repair_writes_them_anew(params, extracted, no_model):
    store = params.extract.store
    before = FeatureStore.open(store).golden
    (store / "golden/2/View1/c/0/0/0").write_bytes(b"rot")
    assert not verify(store).sound
    extract(params, print, repair=True)
    after = assert_golden(params).golden
    assert [golden.key for golden in after] == [golden.key for golden in before]


class _Views:
    """As much of a spec as rendering a prompt needs."""

    views = ("View1", "View2")
    variants = 1
