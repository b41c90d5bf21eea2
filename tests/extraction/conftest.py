"""Small recordings in the windowed format, and params that extract them."""

import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from pipeline.config import Params


@pytest.fixture(scope="session")
def write_episode() -> Callable[..., Path]:
    """`write_episode(folder, seed, ...)` writes one episode."""
    return _write_episode


def _write_episode(
    folder: Path,
    seed: int = 0,
    seconds: float = 2.0,
    views: tuple[str, ...] = ("View1", "View2"),
    sensor: bool = True,
) -> Path:
    """One episode: cameras at 10 Hz, poses at 100 Hz, a sensor of 1,026 channels at 130 Hz."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    start = 1.7e9 + seed
    for view in views:
        (folder / "images" / view).mkdir(parents=True)
        for frame in range(int(seconds * 10) + 1):
            pixels = rng.integers(0, 255, (24, 32, 3), np.uint8)
            name = f"{start + frame / 10:.3f}.jpg"
            Image.fromarray(pixels).save(folder / "images" / view / name)
    states = int(seconds * 100) + 1
    poses = np.cumsum(rng.normal(size=(states, 6)), axis=0) * 0.1
    joints = poses * 0.5
    np.savez(
        folder / "robot_states.npz",
        robot_states=np.concatenate([joints, poses], axis=1).astype(np.float32),
        joints=joints.astype(np.float32),
        poses=poses.astype(np.float32),
    )
    metadata: dict[str, Any] = {
        "episode_name": folder.name,
        "start_time": start,
        "end_time": start + seconds,
        "camera_views": list(views),
        "sensor_hz": 130,
        "robot_hz": 100,
        "sensor_window_size": 13,
    }
    if sensor:
        windows = int(seconds * 10)
        np.savez(
            folder / "sensor_data.npz",
            timestamps=start + (np.arange(windows) + 1) * 0.1,
            data=rng.normal(size=(windows, 13, 1026)).astype(np.float32),
        )
    (folder / "metadata.json").write_text(json.dumps(metadata))
    return folder


@pytest.fixture(scope="session")
def stand_still() -> Callable[[Path], None]:
    """`stand_still(episode)`: each camera of an episode shows its first frame throughout."""

    def still(episode: Path) -> None:
        for view in (episode / "images").iterdir():
            first, *others = sorted(view.iterdir())
            for frame in others:
                shutil.copyfile(first, frame)

    return still


@pytest.fixture(scope="session")
def make_document(demo_checkpoint: Path) -> Callable[[Path], dict[str, Any]]:
    """`make_document(folder)` writes recordings there, and says what params.yaml would.

    Three episodes of one task; the last has one view only and no sensor.
    """

    def make(folder: Path) -> dict[str, Any]:
        root = folder / "recordings"
        _write_episode(root / "Touch_dot" / "episode_1", 1)
        _write_episode(root / "Touch_dot" / "episode_2", 2, seconds=3.0)
        _write_episode(root / "Press" / "episode_3", 3, views=("View2",), sensor=False)
        return {
            "data": {"root": str(root), "sources": [{"name": "made", "path": "."}]},
            "vlm": {
                "checkpoint": str(demo_checkpoint),
                "dtype": "float32",
                "image_resize_height": 56,
                "image_resize_width": 56,
                "pooling": ["mean", "image_mean", "view_mean"],
            },
            "extract": {"store": str(folder / "stores" / "made.zarr"), "batch_size": 4},
        }

    return make


@pytest.fixture
def document(make_document: Callable[[Path], dict[str, Any]], tmp_path: Path) -> dict[str, Any]:
    """params.yaml as it would be read, to be changed by a test."""
    return make_document(tmp_path)


@pytest.fixture
def recordings(document: dict[str, Any]) -> Path:
    """The folder of the recordings."""
    return Path(document["data"]["root"])


@pytest.fixture
def params(document: dict[str, Any]) -> Params:
    return Params.model_validate(document)


@pytest.fixture
def params_file(document: dict[str, Any], tmp_path: Path) -> Path:
    path = tmp_path / "params.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


@pytest.fixture
def changed(document: dict[str, Any]) -> Callable[..., Params]:
    """`changed(vlm={"prompt": ...})`: the params with some values laid over."""

    return partial(laid_over, document)


def laid_over(document: dict[str, Any], **sections: dict[str, Any]) -> Params:
    """The params of a document with some values of its sections replaced."""
    merged = {name: {**document.get(name, {}), **sections.get(name, {})} for name in document}
    return Params.model_validate(merged)
