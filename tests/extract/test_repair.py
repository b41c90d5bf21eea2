"""Damage of every kind, found, repaired and completed: the store is the undamaged one again."""

import errno
import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.base.config import Params
from pipeline.base.errors import DiskFull, StoreIncomplete, StoreLocked, StoreMismatch
from pipeline.extract import ExtractionReport, extract
from pipeline.extract.repair import repair
from pipeline.store import FeatureStore, build_lock, part_path
from pipeline.store.schema import chunk_paths, read_spec
from pipeline.store.verification import Verification, verify
from tests.extract.conftest import contents


def quiet(line: str) -> None:
    """What is said is not looked at."""


@pytest.fixture(scope="module")
def extracted(make_document, tmp_path_factory) -> dict[str, Any]:
    """The document of an extracted store; one row a batch, so that a row's bits are its own."""
    document = make_document(tmp_path_factory.mktemp("extracted"))
    document["extract"]["batch_size"] = 1
    extract(Params.model_validate(document), quiet)
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

    def file(self, array: str, chunk: int = 0) -> Path:
        return chunk_paths(self.store, read_spec(self.store, array))[chunk]

    def flip(self, array: str, byte: int) -> Path:
        path = self.file(array)
        content = bytearray(path.read_bytes())
        content[byte] ^= 0x20
        path.write_bytes(content)
        return path

    def verified(self) -> Verification:
        return verify(self.store, threads=1)

    def mended(self) -> tuple[str, ExtractionReport]:
        """Repair and complete; returns what the repair said, and what extract did."""
        before, said = contents(self.store), list[str]()
        repair(self.verified(), self.params, said.append)
        assert contents(self.store) == before, "the damaged store stays until it is replaced"
        report = extract(self.params, quiet)
        return "\n".join(said), report


@pytest.fixture
def case(extracted, tmp_path) -> Case:
    original = Path(extracted["extract"]["store"])
    copy = tmp_path / "copy.zarr"
    shutil.copytree(original, copy)
    document = extracted | {"extract": extracted["extract"] | {"store": str(copy)}}
    return Case(document, original)


def row_bytes(case: Case) -> int:
    return read_spec(case.store, "vl/features").row_bytes


def flipped_feature(case: Case) -> Path:
    return case.flip("vl/features", 5 * row_bytes(case) + 9)


@pytest.mark.parametrize(
    ("harm", "computed", "anew"),
    [
        (flipped_feature, 1, False),
        (lambda case: case.flip("vl/key", 40), 24, False),
        (lambda case: case.flip("sensor/values", 10_000), 0, True),
        (lambda case: case.flip("episode/tick_start", 8), 0, True),
    ],
)
def test_damage_is_found_and_mended_to_the_byte(case, harm, computed, anew):
    place = harm(case)
    lines = case.verified().lines()
    assert any(str(place) in line for line in lines), lines
    said, report = case.mended()
    assert ("again from the recordings" in said) is anew
    assert f"{report.rows - computed} of {report.rows} feature rows taken over" in said
    assert (report.computed, report.taken) == (computed, 0)
    assert contents(case.store) == contents(case.original)
    assert case.verified().sound
    assert extract(case.params, quiet) is None, "up to date"


def test_metadata_of_the_features_that_are_lost_cost_the_rows(case):
    (case.store / "vl" / "features" / "zarr.json").unlink()
    said, report = case.mended()
    assert " 0 of 24 feature rows taken over" in said
    assert report.computed == report.rows
    assert contents(case.store) == contents(case.original)


def test_attributes_that_cannot_be_are_written_again_and_every_row_is_kept(case):
    place = case.store / "zarr.json"
    document = json.loads(place.read_text())
    document["attributes"].update(sources=[], action_hz="ten")
    place.write_text(json.dumps(document))
    with pytest.raises(StoreIncomplete, match=r"zarr\.json: action_hz: .*; sources: .*--repair"):
        extract(case.params, quiet)
    # Of what was computed with what, its attributes no longer say anything that is believed.
    said, report = case.mended()
    assert "24 of 24 feature rows taken over" in said
    assert report.computed == 0
    assert verify(case.store, threads=1).sound


@pytest.mark.parametrize("place", ["zarr.json", "vl/zarr.json"])
def test_changed_metadata_are_written_again_and_every_row_is_kept(case, place):
    document = json.loads((case.store / place).read_text())
    attributes = document["attributes"]
    if place == "zarr.json":
        attributes["action_hz"] = 30.0
    else:
        attributes["slots"][0]["pooling"] = "last"
    (case.store / place).write_text(json.dumps(document))
    with pytest.raises(StoreIncomplete, match="the metadata were changed"):
        extract(case.params, quiet)
    said, report = case.mended()
    assert "24 of 24 feature rows taken over" in said
    assert report.computed == 0
    assert contents(case.store) == contents(case.original)


def test_streams_cannot_be_mended_from_other_recordings(case):
    case.flip("sensor/values", 10_000)
    case.document["data"] = case.document["data"] | {"vlm_reuse_count": 2}
    with pytest.raises(StoreMismatch, match="the params describe another store"):
        repair(case.verified(), case.params, quiet)
    assert not part_path(case.store).exists()


def test_a_repair_that_has_begun_is_not_begun_again(case):
    flipped_feature(case)
    repair(case.verified(), case.params, quiet)
    with pytest.raises(StoreMismatch, match=r"a repair of it has begun. Run python -m stages.ext"):
        repair(case.verified(), case.params, quiet)


def test_a_full_disk_leaves_nothing_behind(case, monkeypatch):
    flipped_feature(case)
    damaged = case.verified()

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(DiskFull, match="make room"):
        repair(damaged, case.params, quiet)
    names = sorted(path.name for path in case.store.parent.iterdir())
    assert names == ["copy.zarr", "copy.zarr.lock"]


def test_a_repair_waits_for_no_extraction(case):
    flipped_feature(case)
    damaged = case.verified()
    with build_lock(case.store), pytest.raises(StoreLocked, match="being built by process"):
        repair(damaged, case.params, quiet)


def test_nothing_is_taken_over_by_damaged_keys(case, tmp_path):
    """Other params want rows by key: a key that may be wrong is refused, then repaired around."""
    case.flip("vl/key", 40)
    damaged, before = case.verified(), case.params
    case.document["data"] = case.document["data"] | {"action_hz": 5.0}
    with pytest.raises(StoreIncomplete, match=r"vl/key.*stages\.verify --repair"):
        extract(case.params, quiet)
    repair(damaged, before, quiet)
    report = extract(case.params, quiet)
    assert report.taken == 0
    fresh = Params.model_validate(
        case.document | {"extract": {"store": str(tmp_path / "fresh.zarr"), "batch_size": 1}}
    )
    extract(fresh, quiet)
    assert contents(case.store) == contents(fresh.extract.store)


def test_a_store_under_repair_is_not_kept_for_its_rows(case):
    flipped_feature(case)
    repair(case.verified(), case.params, quiet)
    (source,) = case.document["data"]["sources"]
    other = {"sources": [source | {"instruction": "hold still"}]}
    case.document["data"] = case.document["data"] | other
    extract(case.params, quiet)
    assert not case.store.with_name("copy.zarr.previous").exists()


def test_what_was_extracted_holds_together(case, hold_together):
    hold_together(FeatureStore.open(case.store))


def test_training_goes_on_from_the_old_store_meanwhile(case):
    """A map of the damaged store stays what it was after the mended one took its place."""
    flipped_feature(case)
    mapped = FeatureStore.open(case.store).array("vl/features")
    before = mapped[4:8].copy()
    case.mended()
    assert np.array_equal(mapped[4:8], before)
