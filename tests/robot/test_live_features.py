"""Features asked live are those that the store holds, and another model's are refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from pipeline.base.config import Params
from pipeline.base.errors import CheckpointMismatch
from pipeline.data import open_recordings
from pipeline.robot.live_features import LiveFeatures
from pipeline.store import FeatureStore
from pipeline.vlm.demo_checkpoint import write_demo_checkpoint
from pipeline.vlm.live import LiveVLM


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


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"image_resize_width": 112}, r"processor\.resize: \[56, 84\] -> \[56, 112\]"),
        ({"prompt": "{images}{instruction}"}, r'prompt: ".*" -> "\{images\}\{instruction\}"'),
        ({"layers": (0,)}, r"slots\[0\]\.layer: 3 -> 0"),
        ({"pooling": ("mean",)}, "slots: 49 entries -> 1 entries"),
        ({"dtype": "bfloat16"}, 'compute_dtype: "float32" -> "bfloat16"'),
    ],
)
def test_other_features_are_refused_before_a_weight_is_loaded(
    params: Params, monkeypatch: pytest.MonkeyPatch, changed: dict[str, Any], named: str
) -> None:
    def load(*args: Any) -> None:
        raise AssertionError("a weight is loaded")

    monkeypatch.setattr(LiveVLM, "load", load)
    trained = FeatureStore.open(params.extract.store).spec
    with pytest.raises(CheckpointMismatch, match=named):
        LiveFeatures(params.vlm.model_copy(update=changed), trained, "cpu")


@pytest.mark.parametrize("what", ["weights", "adapter"])
def test_another_model_is_refused_before_a_weight_is_loaded(
    params: Params, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    monkeypatch.setattr(LiveVLM, "load", None)
    trained = FeatureStore.open(params.extract.store).spec
    if what == "weights":
        other = tmp_path / "other"
        write_demo_checkpoint(other)
        (weights,) = other.glob("*.safetensors")
        tensors = load_file(weights)
        name = next(iter(tensors))
        save_file(tensors | {name: tensors[name] * 1.5}, weights, {"format": "pt"})
        vlm = params.vlm.model_copy(update={"checkpoint": str(other)})
    else:
        (tmp_path / "adapter_config.json").write_text('{"peft_type": "LORA", "r": 1}')
        save_file({"one": torch.zeros(1)}, tmp_path / "adapter_model.safetensors")
        vlm = params.vlm.model_copy(update={"adapter": str(tmp_path)})
    with pytest.raises(CheckpointMismatch, match=rf"{what}: .* -> "):
        LiveFeatures(vlm, trained, "cpu")


def test_the_key_of_frames_is_that_of_the_policys_store(params: Params) -> None:
    store = FeatureStore.open(params.extract.store)
    live = LiveFeatures(params.vlm, store.spec, "cpu")
    for row in store.golden:
        assert live.key(row.frames, row.instruction) == row.key
