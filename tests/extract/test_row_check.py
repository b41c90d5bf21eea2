"""Rows computed again are the stored ones, or what differs is named."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.base.config import Params
from pipeline.base.errors import StoreMismatch
from pipeline.extract import extract
from pipeline.extract.row_check import Reextraction, reextract
from pipeline.store import FeatureStore
from pipeline.vlm.slots import TOLERANCES
from tests.store.samples import put


@pytest.fixture(scope="module")
def extracted(make_document, tmp_path_factory) -> dict[str, Any]:
    document = make_document(tmp_path_factory.mktemp("extracted"))
    document["vlm"]["variants"] = 2
    extract(Params.model_validate(document), print)
    return document


@pytest.fixture
def document(extracted, tmp_path) -> dict[str, Any]:
    """Of copies of the store and of its recordings."""
    store, root = tmp_path / "copy.zarr", tmp_path / "recordings"
    shutil.copytree(extracted["extract"]["store"], store)
    shutil.copytree(extracted["data"]["root"], root)
    return {
        **extracted,
        "data": extracted["data"] | {"root": str(root)},
        "extract": extracted["extract"] | {"store": str(store)},
    }


def again(document: dict[str, Any], rows: int = 100, **verify: Any) -> Reextraction:
    params = Params.model_validate(document | {"verify": {"reextract": rows, **verify}})
    return reextract(params.extract.store, params, print)


class TestSoundStore:
    def test_every_row_with_all_its_variants(self, document):
        found = again(document)
        assert sorted(one.row for one in found.deviations) == list(range(24))
        assert found.deviations[0].relative < 1e-4
        assert not found.beyond
        assert found.tolerance == TOLERANCES["float32"]
        assert all(one.same_pixels for one in found.deviations)
        assert not found.environment
        assert "computed 24 rows again" in found.lines()[0]

    def test_the_choice_goes_by_the_seed(self, document):
        def rows(seed: int) -> set[int]:
            return {one.row for one in again(document, rows=4, seed=seed).deviations}

        assert rows(1) == rows(1)
        assert rows(1) != rows(2)


class TestDeviations:
    def test_a_changed_variant_of_a_row_is_named(self, document):
        store = Path(document["extract"]["store"])
        features = FeatureStore.open(store).array("vl/features")[11]
        slots = len(features)
        features[slots - 1] *= 1.02
        put(store, "vl/features", 11, features)
        found = again(document)
        (beyond,) = found.beyond
        assert (beyond.row, beyond.slot) == (11, slots - 1)
        assert 1e-2 < beyond.relative < 1e-1
        assert found.deviations[0] == beyond
        assert "VL row 11" in str(beyond)
        assert not again(document, tolerance=0.2).beyond

    @pytest.mark.parametrize("value", [np.nan, np.inf, 0.0], ids=["nan", "infinite", "zeros"])
    def test_no_number_and_a_slot_of_zeros_are_beyond_every_tolerance(self, document, value):
        put(Path(document["extract"]["store"]), "vl/features", 3, value)
        found = again(document, tolerance=1e3)
        assert [one.row for one in found.beyond] == [3]
        assert found.deviations[0].row == 3
        assert found.deviations[0].relative == np.inf

    def test_other_pixels_are_named_as_such(self, document, monkeypatch):
        opened = Image.Image.convert

        def brighter(image, mode=None, *args, **kwargs):
            return opened(image, mode, *args, **kwargs).point(lambda value: min(255, value + 8))

        monkeypatch.setattr(Image.Image, "convert", brighter)
        found = again(document, rows=3)
        assert not any(one.same_pixels for one in found.deviations)
        assert "the decoder of today gives other pixels" in "\n".join(found.lines())


class TestOtherThanTheStore:
    def test_params_of_other_features_are_refused(self, document):
        document["vlm"] = document["vlm"] | {"prompt": "{images}"}
        with pytest.raises(StoreMismatch, match=r"other features.*\n  prompt"):
            again(document)

    def test_episodes_whose_recordings_changed_are_named_and_left_out(self, document):
        image = next(Path(document["data"]["root"]).glob("Press/episode_3/images/View2/*.jpg"))
        Image.fromarray(np.zeros((24, 32, 3), np.uint8)).save(image)
        found = again(document)
        assert found.unchecked == ("episode_3",)
        assert len(found.deviations) < 24
        assert not found.beyond
        assert found.lines()[-1].endswith("changed or is gone: episode_3")

    def test_no_recording_is_left_as_it_was(self, document):
        document["data"] = document["data"] | {"action_hz": 5}
        found = again(document)
        assert found.lines()[0] == "no row can be computed again"
        assert len(found.unchecked) == 3
