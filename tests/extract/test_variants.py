"""`vlm.variants`: one extraction stores each row as its frames are, and augmented."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.base.config import Params
from pipeline.base.errors import DiskFull
from pipeline.base.text import size
from pipeline.store import FeatureStore
from pipeline.store.schema import ARRAY_NAMES
from tests.extract.conftest import run

K = 3


def features_by_key(store: FeatureStore) -> dict[bytes, np.ndarray]:
    return dict(zip(map(bytes, store.array("vl/key")), store.array("vl/features"), strict=True))


@pytest.fixture(scope="module")
def extracted(make_document, tmp_path_factory) -> dict[int, FeatureStore]:
    """The same recordings as a store of one variant and of three, a pass of the model a variant."""
    document = make_document(tmp_path_factory.mktemp("extracted"))
    stores = {}
    for variants in (1, K):
        place = Path(document["extract"]["store"]).with_name(f"{variants}.zarr")
        params = Params.model_validate(
            document
            | {"vlm": document["vlm"] | {"variants": variants}}
            | {"extract": {"store": str(place), "batch_size": 1}}
        )
        run(params)
        stores[variants] = FeatureStore.open(place)
    return stores


class TestWhatItWrites:
    def test_variant_0_is_the_store_of_one_bit_for_bit_and_the_others_differ(self, extracted):
        plain, store = extracted[1], extracted[K]
        assert (store.variants, plain.variants) == (K, 1)
        assert store.feature_shape == plain.feature_shape
        rows = store.array("vl/features")
        variants = rows.reshape(len(rows), K, *store.feature_shape).swapaxes(0, 1)
        assert np.array_equal(variants[0], plain.array("vl/features"))
        for name in ("tick/action", "tick/vl_row", "vl/time", "vl/frame_time", "sensor/values"):
            assert np.array_equal(store.array(name), plain.array(name), equal_nan=True)
        seen = store.array("vl/slot_valid")[:, : store.feature_shape[0]].astype(bool)
        for a, b in ((0, 1), (0, 2), (1, 2)):
            assert (np.abs(variants[a] - variants[b]).max(axis=-1)[seen] > 1e-3).all()
        assert not features_by_key(plain).keys() & features_by_key(store).keys()

    def test_slots_are_named_variant_after_variant(self, extracted):
        plain, store = extracted[1].attrs["slots"], extracted[K].attrs["slots"]
        assert store == [slot | {"variant": v} for v in range(K) for slot in plain]
        assert store == extracted[K].spec["slots"]

    def test_a_missing_view_is_missing_in_every_variant(self, extracted):
        store = extracted[K]
        press = next(one for one in store.episodes if one.id == "episode_3")
        batch = store.gather(np.array([press.ticks[0]] * K), variants=np.arange(K))
        slots = extracted[1].attrs["slots"]
        view1 = [slot.get("view") == "View1" for slot in slots]
        assert not batch.slot_valid[:, view1].any()
        assert not batch.features[:, view1].any()
        assert batch.slot_valid[:, np.logical_not(view1)].all()
        assert len({row.numpy().tobytes() for row in batch.features}) == K


def test_neither_batch_nor_threads_nor_order_nor_episode_decide_a_variant(
    extracted, changed, recordings, write_episode
):
    write_episode(recordings / "Press" / "episode_0", 9)  # in front: every row moves
    params = changed(vlm={"variants": K}, extract={"batch_size": 7, "decode_threads": 3})
    report, _ = run(params)
    assert report.taken == 0
    found, known = features_by_key(FeatureStore.open(params.extract.store)), extracted[K]
    for key, features in features_by_key(known).items():
        assert np.allclose(found[key], features, atol=2e-5)


def test_the_plan_and_the_disk_check_count_every_variant(extracted, changed, monkeypatch):
    needed = {
        variants: sum(store.array(name).nbytes for name in ARRAY_NAMES)
        for variants, store in extracted.items()
    }
    features, valid = (
        extracted[1].array(f"vl/{name}").nbytes for name in ("features", "slot_valid")
    )
    assert needed[K] - needed[1] == (K - 1) * (features + valid)
    _, said = run(changed(vlm={"variants": K}, extract={"plan": True}))
    assert "rows: 24, 0 known, 24 to compute in 3 variants each" in said
    assert f"disk: {size(needed[K])} for the whole store" in "\n".join(said)
    monkeypatch.setattr("pipeline.extract.streams.free_bytes", lambda path: needed[K] - 1)
    with pytest.raises(DiskFull, match=r"fewer vlm\.pooling slots or vlm\.variants"):
        run(changed(vlm={"variants": K}))
