"""Features asked live are those that the store holds, and another model's are refused."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.base.config import Params
from pipeline.base.errors import CheckpointMismatch
from pipeline.data import open_recordings
from pipeline.extract.run import extract
from pipeline.robot.features import LiveFeatures
from pipeline.simulation.insertion_formats import write_raw
from pipeline.simulation.recorder import simulate_episode
from pipeline.store import FeatureStore


@pytest.fixture(scope="module")
def params(tmp_path_factory: pytest.TempPathFactory, demo_checkpoint: Path) -> Params:
    """Params of one recorded episode, whose store is extracted."""
    root = tmp_path_factory.mktemp("live")
    write_raw(root / "raw" / "Red_point", simulate_episode(5, 1.7e9))
    vlm = {
        "checkpoint": str(demo_checkpoint),
        "image_resize_height": 56,
        "image_resize_width": 84,
        "dtype": "float32",
        "pooling": ["mean", "grid"],
    }
    document = {
        "data": {"root": str(root), "sources": [{"name": "raw", "path": "raw"}]},
        "vlm": vlm,
        "extract": {"store": str(root / "store.zarr")},
    }
    params = Params.model_validate(document)
    extract(params, say=lambda _: None)
    return params


def test_live_features_are_the_stored_ones(params: Params) -> None:
    store = FeatureStore.open(params.extract.store)
    (recording,) = open_recordings(params.data.sources, params.data.root).recordings
    cameras, times = recording.cameras(), store.array("vl/frame_time")
    rows = np.arange(0, len(times), 3)
    frames: list[dict[str, np.ndarray]] = [{} for _ in rows]
    for place, (view, camera) in enumerate(sorted(cameras.items())):
        shown = np.searchsorted(camera.time, times[rows, place])
        for views, image in zip(frames, camera.read(shown.tolist()), strict=True):
            views[view] = image
    live = LiveFeatures(params.vlm, store.spec, "cpu")
    features, valid = live(frames, recording.instruction)
    np.testing.assert_allclose(features, store.array("vl/features")[rows], atol=2e-5)
    assert valid.all()


def test_a_model_that_gives_other_features_is_refused(params: Params) -> None:
    trained = FeatureStore.open(params.extract.store).spec
    other = params.vlm.model_copy(update={"image_resize_width": 112})
    with pytest.raises(CheckpointMismatch, match="processor"):
        LiveFeatures(other, trained, "cpu")
