"""Simulated recordings in the old and the new format, and a store of them."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.base.config import Params
from pipeline.extract import extract
from pipeline.simulation.insertion_formats import ABUTTING, write_new, write_old
from pipeline.simulation.recorder import simulate_episode
from pipeline.store import FeatureStore

EPOCH_S = 1.767e9 + 0.25
OVERLAPPING = (130, 65)
"""Less than the recorder's windows overlap, which would take seconds at every reading."""


@pytest.fixture(scope="session")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`old/` with one episode, `new/` with two."""
    root = tmp_path_factory.mktemp("recordings")
    write_old(root / "old" / "Red_point", simulate_episode(1, EPOCH_S, True))
    for index, windows in enumerate((ABUTTING, OVERLAPPING)):
        episode = simulate_episode(2 + index, EPOCH_S + 100 * (1 + index))
        write_new(root / "new" / "Red_point", episode, windows, robot_clock=bool(index))
    return root


@pytest.fixture(scope="session")
def extracted(recordings: Path, demo_checkpoint: Path) -> FeatureStore:
    """The store of these recordings, the old ones under a name of the store's own."""
    sources = [{"name": "first", "path": "old"}, {"name": "second", "path": "new"}]
    target = recordings / "stores" / "both.zarr"
    document = {
        "data": {"root": str(recordings), "sources": sources},
        "vlm": {
            "checkpoint": str(demo_checkpoint),
            "image_resize_height": 56,
            "image_resize_width": 56,
            "dtype": "float32",
            "pooling": ["mean"],
        },
        "extract": {"store": str(target)},
    }
    extract(Params.model_validate(document), say=lambda _: None)
    return FeatureStore.open(target)


@pytest.fixture
def copied(recordings: Path, tmp_path: Path) -> Callable[[str], Path]:
    """`copied("new")`: a copy of one format's recordings that a test may damage."""

    def copy(format: str) -> Path:
        return Path(shutil.copytree(recordings / format, tmp_path / format))

    return copy
