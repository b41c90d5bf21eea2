"""Projected features: one basis for all rows of a store, whoever computes or takes them."""

from contextlib import closing
from itertools import groupby

import numpy as np
import pytest
from tqdm import tqdm

from pipeline.base.arrays import widen
from pipeline.base.digests import ContentDigests
from pipeline.base.errors import ConfigError, VLMError
from pipeline.base.projection import apply_map
from pipeline.extract import extract
from pipeline.extract.basis import fit_basis
from pipeline.extract.row_check import reextract
from pipeline.extract.survey import sound_episodes, survey
from pipeline.store import FeatureStore, part_path
from pipeline.store.archive import archive, restore
from pipeline.store.chunks import read_rows
from pipeline.store.inventory import describe_stores, list_stores
from pipeline.store.merging import merge
from pipeline.store.proofs import Loss, Proof, proof_of, slots_digest, write_proofs
from pipeline.store.schema import BASIS, read_spec
from pipeline.store.verification import verify
from tests.extract.conftest import run
from tests.store.samples import content

PROJECTED = {"dtype": {"pca": 12, "then": "int8"}}


@pytest.fixture
def projected(changed, extracted, tmp_path):
    """Params of a store with 12 numbers a slot; beside it lies one in float32."""
    params = changed(extract={"store": str(tmp_path / "stores" / "few.zarr"), **PROJECTED})
    return params, FeatureStore.open(tmp_path / "stores" / "made.zarr")


def test_rows_are_the_projected_features(projected):
    params, whole = projected
    losses = [
        Loss(of="a group", slots=slots_digest(slots), r2=-0.01, error_std=0.02)
        for _, slots in groupby(whole.spec["slots"], lambda slot: slot["pooling"])
    ]
    proof = Proof(store="made.zarr", recordings=3, ticks=60, losses=losses)
    write_proofs(whole.path, whole.spec, {"pca 12 in int8": proof})
    report, lines = run(params)
    store = FeatureStore.open(params.extract.store)
    assert report.computed == len(whole.array("vl/time"))
    assert any(line.startswith("basis of 12 of 128 numbers a slot") for line in lines)
    assert store.feature_shape == (whole.feature_shape[0], 12)
    assert verify(store.path).sound
    assert proof_of(store.attrs) == proof
    listed = "\n".join(describe_stores(path := store.path.parent, list_stores(path), {}))
    assert "x 12 (PCA of 128) in int8" in listed
    assert f"as it is stored, {proof}" in listed
    values, full = widen(store.array("vl/features")), whole.array("vl/features")
    valid = whole.array("vl/slot_valid").astype(bool)
    group = [0, 1, 2, 2]  # mean, image_mean, and view_mean of two views
    for slot, own in enumerate(group):
        expected = apply_map(full[:, slot], store.basis.maps[own])
        there = valid[:, slot]
        assert not values[~there, slot].any()
        assert np.abs(values[there, slot] - expected[there]).max() < 0.05
        spread = values[there, slot].std(axis=0)
        assert spread[0] > 0.8


def test_the_same_recordings_give_the_same_basis_to_the_bit(projected, monkeypatch):
    params, _ = projected
    with closing(ContentDigests(None)) as digests:
        surveyed, checked = sound_episodes(survey(params, digests), digests)
    one, _ = fit_basis(surveyed, checked)

    def shown(*given, **options):
        return tqdm(*given, **options | {"disable": False})  # as on a terminal

    monkeypatch.setattr("pipeline.extract.basis.tqdm", shown)
    two, _ = fit_basis(surveyed, checked)
    assert one.maps.tobytes() == two.maps.tobytes()
    monkeypatch.setattr("pipeline.extract.basis.SAMPLE_ROWS", 6)
    with pytest.raises(ConfigError, match=r"one of these has 6\. Set a smaller pca"):
        fit_basis(surveyed, checked)


def test_a_basis_outlives_a_kill_new_recordings_damage_and_copies(
    projected, changed, interrupted, write_episode, recordings, monkeypatch, tmp_path
):
    params, _ = projected
    path = params.extract.store
    interrupted(params, 1)
    begun = read_rows(part := part_path(path), read_spec(part, BASIS))
    monkeypatch.setattr("pipeline.extract.basis.fit_basis", None)  # nothing fits one from here on
    run(params)
    basis = FeatureStore.open(path).basis
    assert np.array_equal(basis.maps, begun)
    assert run(params)[0] is None

    write_episode(recordings / "Press" / "episode_4", 4)
    report, lines = run(params)
    grown = FeatureStore.open(path)
    assert grown.basis.digest == basis.digest
    assert report.taken > 0 < report.computed
    assert any("the basis of the store or build there is kept" in line for line in lines)

    archive(path, tmp_path / "few.archive.zarr", 1, 1)
    restore(tmp_path / "few.archive.zarr", tmp_path / "again.zarr", 1)
    assert content(tmp_path / "again.zarr") == content(path)

    damaged = np.memmap(path / "vl/features/c/0/0/0", np.uint8, "r+")
    damaged[:8] ^= 0xFF
    damaged.flush()
    report = extract(params, lambda line: None, repair=True)
    assert report.computed >= 1
    assert verify(path).sound
    assert not reextract(path, changed(verify={"reextract": 3}, extract=PROJECTED), print).beyond


def test_a_damaged_basis_is_fitted_again(projected):
    params, _ = projected
    run(params)
    store = params.extract.store
    np.memmap(store / "vl/basis/c/0/0/0", np.uint8, "r+")[:8] ^= 0xFF
    assert "vl/basis" in " ".join(verify(store).issues)
    extract(params, lambda line: None, repair=True)
    assert verify(store).sound


def test_stores_of_one_basis_are_merged(projected, changed, monkeypatch, tmp_path):
    params, whole = projected
    run(params)
    first, second = params.extract.store, tmp_path / "stores" / "second.zarr"
    monkeypatch.setattr("pipeline.extract.basis.fit_basis", None)  # nothing fits one from here on

    def on(basis):
        dtype = PROJECTED["dtype"] | {"basis": str(basis)}
        return changed(extract={"store": str(second), "dtype": dtype})

    for other in (whole.path, tmp_path / "nowhere.zarr"):
        with pytest.raises(ConfigError, match=r"extract\.dtype\.basis: .* found none"):
            run(on(other))
    _, lines = run(on(first))
    assert f"why: the basis of {first} is taken" in lines
    merge([first, second], tmp_path / "stores" / "merged.zarr")
    merged = FeatureStore.open(tmp_path / "stores" / "merged.zarr")
    assert merged.basis.digest == FeatureStore.open(first).basis.digest
    assert verify(merged.path).sound


def test_a_plan_fits_nothing(projected):
    params, _ = projected
    only = params.extract.model_copy(update={"plan": True})
    report, lines = run(params.model_copy(update={"extract": only}))
    assert report is None
    assert any(line.startswith("rows: ") for line in lines)
    assert not params.extract.store.exists()


def test_augmented_variants_share_the_basis(changed, tmp_path):
    vlm = {"variants": 2, "pooling": ["mean"]}
    params = changed(vlm=vlm, extract={"store": str(tmp_path / "two.zarr"), **PROJECTED})
    run(params)
    store = FeatureStore.open(params.extract.store)
    assert store.basis.maps.shape == (1, 129, 12)
    assert store.array("vl/features").shape[1] == 2
    assert widen(store.array("vl/features"))[:, 1].any(axis=1).all()


def test_no_more_numbers_than_the_model_has(changed):
    with pytest.raises(VLMError, match="Set pca to at most 128"):
        run(changed(extract={"dtype": {"pca": 129}}))


@pytest.mark.slow
def test_workers_project_on_the_basis_of_the_coordinator(projected, changed):
    params, _ = projected
    run(params)
    one = FeatureStore.open(params.extract.store)
    other = params.extract.store.with_name("other.zarr")
    run(changed(extract={"store": str(other), "workers": 2, **PROJECTED}))
    two = FeatureStore.open(other)
    assert one.basis.digest == two.basis.digest
    values = [widen(store.array("vl/features")) for store in (one, two)]
    assert np.abs(values[0] - values[1]).max() < 0.05
