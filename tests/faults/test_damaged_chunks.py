"""A chunk file cut off, bit-flipped or gone: an error that names it, or a correct result."""

import os
from pathlib import Path

import numpy as np
import pytest

from pipeline.base.config import Params
from pipeline.extract import extract
from pipeline.store import FeatureStore
from pipeline.store.schema import ARRAY_NAMES
from tests.store.samples import flip


def flipped(chunk: Path) -> None:
    """One bit of the first row."""
    flip(chunk, 1000, 4)


@pytest.fixture(scope="module")
def right(make_document, write_episode, tmp_path_factory) -> FeatureStore:
    """What extraction makes of the recordings and one more episode, without a store before."""
    params = Params.model_validate(make_document(tmp_path_factory.mktemp("right")))
    write_episode(params.data.root / "Touch_dot" / "episode_4", 4)
    extract(params, print)
    return FeatureStore.open(params.extract.store)


@pytest.mark.parametrize(
    ("harm", "chunk"),
    [
        (lambda chunk: os.truncate(chunk, 1000), "vl/features/c/0/0/0"),
        (flipped, "vl/features/c/0/0/0"),
        (Path.unlink, "vl/features/c/0/0/0"),
        (flipped, "sensor/values/c/0/0"),
        (Path.unlink, "tick/action/c/0/0"),
    ],
)
def test_an_extraction_beside_it_takes_no_wrong_row(
    document, store, recordings, write_episode, right, harm, chunk
):
    """Of the old store only rows that give their checksums are taken; streams are read anew."""
    write_episode(recordings / "Touch_dot" / "episode_4", 4)
    harm(store / chunk)
    extract(Params.model_validate(document), print)
    mended = FeatureStore.open(store)
    assert len(mended.episodes) == 4
    for name in set(ARRAY_NAMES) - {"vl/features", "vl/checksum"}:
        assert np.array_equal(mended.array(name), right.array(name), equal_nan=True), name
    # Rows that were lost are computed again, within the noise of float32.
    assert np.allclose(mended.array("vl/features"), right.array("vl/features"), atol=2e-5)
