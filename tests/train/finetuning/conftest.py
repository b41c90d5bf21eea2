"""Small recordings whose motion only an image tells, the store of them, and params that tune."""

import copy
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageDraw

from pipeline.base.config import Params
from pipeline.extract import extract
from pipeline.store import FeatureStore

VIEWS = ("View1", "View2")
SMALL_HEAD: dict[str, Any] = {
    "sensor_enabled": False,
    "robot_state_enabled": False,
    "expert": {"dim": 16, "layers": 1, "heads": 2, "dropout": 0.1},
    "horizon": 2,
    "lr": 3e-3,
    "ema_decay": 0.5,
    "split": {"seed": 11, "val": 0.3, "test": 0.2},
    "device": "cpu",
}
SMALL_TUNING: dict[str, Any] = {
    "tuning": {"lora_r": 4, "lora_alpha": 8},
    "lr": 1e-3,
    "batch_size": 6,
    "max_steps": 5,
    "warmup_steps": 1,
    "eval_every": 3,
    "eval_ticks": 6,
    "checkpoint_every": 2,
}


def write_episode(folder: Path, seed: int, views: tuple[str, ...] = VIEWS) -> None:
    """Two seconds of the windowed format: the arm goes where a disc stands off the middle."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    start, phase = 1.7e9 + 100 * seed, rng.uniform(0, 2 * np.pi)

    def place(time: Any) -> Any:
        return np.sin(2 * np.pi * 0.6 * time + phase)

    for view in views:
        (folder / "images" / view).mkdir(parents=True)
        for frame in range(21):
            image = Image.new("RGB", (64, 48), (40, 60, 30 + 20 * (view == "View2")))
            x = 32 + 20 * place(frame / 10)
            ImageDraw.Draw(image).ellipse((x - 8, 16, x + 8, 32), fill=(230, 80, 60))
            image.save(folder / "images" / view / f"{start + frame / 10:.3f}.jpg")
    poses = np.zeros((201, 6))
    poses[1:, 0] = np.cumsum(place(np.arange(200) / 100)) * 0.1
    states = np.concatenate([poses * 0.5, poses], axis=1).astype(np.float32)
    np.savez(
        folder / "robot_states.npz",
        robot_states=states,
        joints=states[:, :6],
        poses=states[:, 6:],
    )
    metadata = {
        "episode_name": folder.name,
        "start_time": start,
        "end_time": start + 2.0,
        "camera_views": list(views),
        "robot_hz": 100,
    }
    (folder / "metadata.json").write_text(json.dumps(metadata))


@pytest.fixture(scope="session")
def _made(tmp_path_factory, demo_checkpoint):
    """Recordings, and params.yaml as it would be read, of a finished store."""
    root = tmp_path_factory.mktemp("finetuning")
    for seed in range(4):
        views = VIEWS if seed else VIEWS[:1]
        write_episode(root / "recordings" / "Follow_disc" / f"episode_{seed}", seed, views)
    document = {
        "data": {"root": str(root / "recordings"), "sources": [{"name": "made", "path": "."}]},
        "vlm": {
            "checkpoint": str(demo_checkpoint),
            "dtype": "float32",
            "image_resize_height": 56,
            "image_resize_width": 84,
            "pooling": ["mean", "grid"],
        },
        "extract": {"store": str(root / "made.zarr"), "device": "cpu"},
        "train_head": SMALL_HEAD,
        "finetune": SMALL_TUNING,
    }
    extract(Params.model_validate(document), say=lambda _: None)
    return root, document


@pytest.fixture
def document(_made, tmp_path):
    """params.yaml as it would be read, to be changed by a test, which must not change files."""
    document = copy.deepcopy(_made[1])
    document["finetune"] |= {"output": str(tmp_path / "tuned"), "logs": str(tmp_path / "logs")}
    return document


@pytest.fixture
def own_recordings(document, tmp_path):
    """A copy of the recordings, that `document` names from now on, to be changed by a test."""
    copied = shutil.copytree(document["data"]["root"], tmp_path / "recordings")
    document["data"]["root"] = str(copied)
    return copied


@pytest.fixture
def store(document):
    return FeatureStore.open(document["extract"]["store"])


@pytest.fixture
def params(document):
    """`params(vlm={...}, ...)`: the document with some values laid over."""

    def lay_over(**sections: dict[str, Any]) -> Params:
        merged = {name: values | sections.get(name, {}) for name, values in document.items()}
        return Params.model_validate(merged)

    return lay_over
