"""A store in int8 or float8 is read, checked, continued and trained from like any other."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from pipeline.base.arrays import widen
from pipeline.base.config import Params
from pipeline.base.packing import unpack
from pipeline.evaluate.ablation import zeroed
from pipeline.extract.row_check import reextract
from pipeline.policy.policy import Policy
from pipeline.store import FeatureStore
from pipeline.store.verification import verify
from pipeline.train.batches import Windows
from pipeline.train.run import policy_shape
from pipeline.train.statistics import fit_normalization
from tests.extract.conftest import run

SLOTS = {"pooling": [{"grid": [1, 2]}, "tokens"], "layers": ["vision", -1], "norms": [False]}


@pytest.fixture(scope="module")
def stores(make_document, tmp_path_factory) -> dict[str, tuple[Params, FeatureStore]]:
    """The same recordings in three storage dtypes."""
    document = make_document(tmp_path_factory.mktemp("packed"))
    found = {}
    for dtype in ("float32", "int8", "float8"):
        place = Path(document["extract"]["store"]).with_name(f"{dtype}.zarr")
        extract = document["extract"] | {"store": str(place), "dtype": dtype}
        changed = document | {"extract": extract, "vlm": document["vlm"] | SLOTS}
        params = Params.model_validate(changed)
        run(params)
        found[dtype] = params, FeatureStore.open(place)
    return found


@pytest.mark.parametrize("dtype", ["int8", "float8"])
def test_rows_are_those_of_float32_within_a_code(stores, dtype):
    (_, whole), (params, store) = stores["float32"], stores[dtype]
    assert store.feature_shape == whole.feature_shape
    held = store.array("vl/features")
    assert held.dtype.name == {"int8": "int8", "float8": "uint8"}[dtype]
    assert held.nbytes < 0.3 * whole.array("vl/features").nbytes
    numbers, exact = widen(held), whole.array("vl/features")
    largest = np.abs(exact).max(axis=-1, keepdims=True)
    assert (np.abs(numbers - exact) <= largest / (100 if dtype == "int8" else 15)).all()
    assert verify(store.path).sound
    some = params.model_copy(update={"verify": params.verify.model_copy(update={"reextract": 4})})
    again = reextract(store.path, some, lambda line: None)
    assert not again.beyond and len(again.deviations) == 4


@pytest.mark.parametrize("dtype", ["int8", "float8"])
def test_a_batch_hands_out_codes_and_the_policy_reads_numbers(stores, dtype):
    _, store = stores[dtype]
    ticks, windows = np.arange(store.ticks), Windows(4, 5, 5)
    batch = store.gather(ticks[:6], 4, 5, 5)
    assert batch.features.dtype == {"int8": torch.int8, "float8": torch.uint8}[dtype]
    normalization = fit_normalization(store, ticks, windows)
    shape = policy_shape(store, normalization)
    assert normalization.features is not None
    # The tokens of a layer and view share their statistics.
    assert normalization.features.mean.shape == (2 * (2 * 2 + 2), shape.feature_dim)
    params = stores[dtype][0].train_head.model_copy(update={"horizon": 4})
    policy = Policy(params, shape, normalization).eval()
    read = policy.act(batch)
    plain = replace(batch, features=unpack(batch.features))
    torch.testing.assert_close(policy.act(plain), read)
    # A stream that is off: its mean, whatever it is stored in, of two rows too.
    both = store.gather(ticks[:6], 4, 5, 5, feature_history=2)
    off = zeroed("features", np.zeros((2 * shape.slots, shape.feature_dim)))(both)
    assert off.features.shape == (6, 2 * shape.slots, shape.feature_dim)


def test_a_model_with_huge_channels_is_recomputed_within_a_code(stores, tmp_path):
    """As released models have: a few channels hundreds of times larger than all others."""
    params, plain = stores["float32"]
    folder = Path(shutil.copytree(params.vlm.checkpoint, tmp_path / "huge"))
    huge = [5, 70]
    for file in folder.glob("*.safetensors"):
        tensors = load_file(file)
        for name in tensors:
            if name.endswith("language_model.norm.weight") or name == "model.norm.weight":
                tensors[name][huge] *= 500
        save_file(tensors, file, {"format": "pt"})
    normed = {"checkpoint": str(folder), "layers": (-1,), "norms": (True,)}
    vlm = params.vlm.model_copy(update=normed)
    some = params.verify.model_copy(update={"reextract": 4})
    others = np.setdiff1d(np.arange(plain.feature_shape[1]), huge)
    for dtype in ("int8", "float8"):
        place = tmp_path / f"{dtype}.zarr"
        extract = params.extract.model_copy(update={"store": place, "dtype": dtype})
        asked = params.model_copy(update={"vlm": vlm, "extract": extract, "verify": some})
        run(asked)
        assert verify(place).sound
        numbers = widen(FeatureStore.open(place).array("vl/features")).astype(np.float64)
        sizes = np.sqrt(np.square(numbers).mean(axis=(0, 1)))
        assert sizes[huge].min() > 100 * np.median(sizes[others])
        assert not reextract(place, asked, lambda line: None).beyond
