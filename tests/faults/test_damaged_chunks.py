"""A chunk file cut off, bit-flipped or gone: an error that names it, or a correct result."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.base.config import Params
from pipeline.extract import extract
from pipeline.store import FeatureStore
from pipeline.store.schema import ARRAY_NAMES
from tests.store.samples import flip

HARMS: dict[str, Callable[[Path], None]] = {
    "cut": lambda chunk: os.truncate(chunk, 1000),
    "flipped": lambda chunk: flip(chunk, 1000, 4),  # of the second VL row
    "gone": Path.unlink,
}
CHUNKS = ["vl/features/c/0/0/0", "sensor/values/c/0/0", "tick/action/c/0/0"]
each_harm = pytest.mark.parametrize(
    ("harm", "chunk"),
    [
        pytest.param(harm, chunk, marks=[pytest.mark.slow] * (bool(place) and place != turn))
        for turn, harm in enumerate(HARMS)
        for place, chunk in enumerate(CHUNKS)
    ],
)
"""Every harm to the features, and one to each other array."""


def nothing(line: str) -> None:
    """Says nothing."""


@pytest.fixture(scope="module")
def right(extracted, write_episode, tmp_path_factory) -> FeatureStore:
    """What extraction makes of an undamaged store and one more episode."""
    source, document = extracted
    folder = Path(shutil.copytree(source, tmp_path_factory.mktemp("right") / "copy"))
    write_episode(folder / "recordings" / "Touch_dot" / "episode_4", 4)
    path = folder / "stores" / "made.zarr"
    changed = {
        "data": document["data"] | {"root": str(folder / "recordings")},
        "extract": document["extract"] | {"store": str(path)},
    }
    extract(Params.model_validate(document | changed), nothing)
    return FeatureStore.open(path)


@each_harm
def test_an_extraction_beside_it_takes_no_wrong_row(
    document, store, recordings, write_episode, right, harm, chunk
):
    """Of the old store only rows that give their checksums are taken; streams are read anew."""
    write_episode(recordings / "Touch_dot" / "episode_4", 4)
    HARMS[harm](store / chunk)
    extract(Params.model_validate(document), nothing)
    mended = FeatureStore.open(store)
    assert len(mended.episodes) == 4
    for name in set(ARRAY_NAMES) - {"vl/features", "vl/checksum"}:
        assert np.array_equal(mended.array(name), right.array(name), equal_nan=True), name
    # Rows that were lost are computed again, within the noise of float32.
    assert np.allclose(mended.array("vl/features"), right.array("vl/features"), atol=2e-5)
