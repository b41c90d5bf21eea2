"""Damage of every kind, found and repaired: the store is the undamaged one again."""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import pytest

from pipeline.base.config import Params
from pipeline.base.errors import StoreIncomplete, StoreMismatch
from pipeline.extract import ExtractionReport, extract
from pipeline.store import FeatureStore, StoreBuild, part_path
from pipeline.store.schema import read_spec
from pipeline.store.verification import verify
from tests.extract.conftest import run
from tests.store.samples import chunk_file, content, edit, flip


@pytest.fixture(scope="module")
def extracted(make_document, tmp_path_factory) -> dict[str, Any]:
    """The document of an extracted store; one row a batch, so that a row's bits are its own."""
    document = make_document(tmp_path_factory.mktemp("extracted"))
    document["extract"]["batch_size"] = 1
    run(Params.model_validate(document))
    return document


@dataclass
class Case:
    """A copy of the extracted store, to be damaged."""

    document: dict[str, Any]
    original: Path

    @property
    def params(self) -> Params:
        return Params.model_validate(self.document)

    @property
    def store(self) -> Path:
        return self.params.extract.store

    def flip(self, array: str, byte: int) -> Path:
        path = chunk_file(self.store, array)
        flip(path, byte, 5)
        return path

    def mended(self) -> ExtractionReport:
        report = extract(self.params, lambda line: None, repair=True)
        assert report is not None
        return report


@pytest.fixture
def case(extracted, tmp_path) -> Case:
    original = Path(extracted["extract"]["store"])
    copy = tmp_path / "copy.zarr"
    shutil.copytree(original, copy)
    document = extracted | {"extract": extracted["extract"] | {"store": str(copy)}}
    return Case(document, original)


def flipped_feature(case: Case) -> Path:
    return case.flip("vl/features", 5 * read_spec(case.store, "vl/features").row_bytes + 9)


@pytest.mark.parametrize(
    ("harm", "computed"),
    [
        (flipped_feature, 1),
        (lambda case: case.flip("vl/key", 40), 24),
        (lambda case: case.flip("vl/checksum", 40), 1),
        (lambda case: case.flip("sensor/values", 10_000), 0),
        (lambda case: case.flip("episode/text", 8), 0),
    ],
)
def test_damage_is_found_and_mended_to_the_byte(case, harm, computed):
    place = harm(case)
    assert any(str(place) in issue for issue in verify(case.store).issues)
    report = case.mended()
    assert (report.computed, report.taken) == (computed, 24 - computed)
    assert content(case.store) == content(case.original)
    assert extract(case.params, print) is None, "up to date"
    assert sorted(path.name for path in case.store.parent.glob("copy.zarr*/")) == ["copy.zarr"]


def test_metadata_of_the_features_that_are_lost_cost_the_rows(case):
    (case.store / "vl" / "features" / "zarr.json").unlink()
    report = case.mended()
    assert report.computed == report.rows
    assert content(case.store) == content(case.original)


def test_changed_metadata_are_written_again_and_every_row_is_kept(case):
    edit(case.store / "zarr.json", lambda document: document["attributes"].update(action_hz=30.0))
    edit(case.store / "vl/zarr.json", lambda document: document["attributes"].clear())
    with pytest.raises(StoreIncomplete, match="the metadata were changed"):
        run(case.params)
    assert case.mended().computed == 0
    assert content(case.store) == content(case.original)


def test_features_and_checksums_of_an_older_copy_are_not_taken(case):
    """They fit each other, but belong to other keys."""
    for array in ("vl/features", "vl/checksum"):
        spec = read_spec(case.store, array)
        path = chunk_file(case.store, array)
        rows, used = path.read_bytes()[:-4], spec.shape[0] * spec.row_bytes
        rows = rows[spec.row_bytes : used] + rows[: spec.row_bytes] + rows[used:]
        path.write_bytes(rows + google_crc32c.value(rows).to_bytes(4, "little"))
    assert case.mended().computed == 24
    assert content(case.store) == content(case.original)


def test_lost_checksums_cost_the_rows(case):
    chunk_file(case.store, "vl/checksum").unlink()
    assert case.mended().computed == 24
    assert content(case.store) == content(case.original)


def test_arrays_of_other_lengths_are_found_and_mended(case):
    edit(case.store / "vl/checksum/zarr.json", lambda document: document.update(shape=[3]))
    assert any("metadata were changed" in issue for issue in verify(case.store).issues)
    case.mended()
    assert content(case.store) == content(case.original)


def test_other_params_repair_nothing(case):
    case.flip("sensor/values", 10_000)
    case.document["data"] = case.document["data"] | {"vlm_reuse_count": 2}
    with pytest.raises(StoreMismatch, match="expected the params that it was extracted with"):
        case.mended()
    assert not part_path(case.store).exists()


def test_a_repair_that_was_stopped_is_completed_by_any_run(case, monkeypatch):
    """The damaged store stays until then, and a map of it afterwards."""
    flipped_feature(case)
    before, mapped = content(case.store), FeatureStore.open(case.store).array("vl/features")
    rows = mapped[4:8].copy()

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(StoreBuild, "seal", stop)
        case.mended()
    assert content(case.store) == before
    report, said = run(case.params)
    assert report.computed == 0
    assert any("continuing the interrupted build" in line for line in said)
    assert content(case.store) == content(case.original)
    assert np.array_equal(mapped[4:8], rows)


def test_nothing_is_taken_by_damaged_keys(case):
    """Other params want rows by key: a key that may be wrong is refused."""
    case.flip("vl/key", 40)
    case.document["data"] = case.document["data"] | {"action_hz": 5.0}
    with pytest.raises(StoreIncomplete, match=r"vl/key.*stages\.verify --repair"):
        run(case.params)


def test_what_was_extracted_holds_together(case, hold_together):
    hold_together(FeatureStore.open(case.store))
