"""Live features are those of the store; another model is refused with the reason."""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from pipeline.base.config import Params, load_params
from pipeline.base.errors import CheckpointIncomplete, CheckpointMismatch
from pipeline.data import open_recordings
from pipeline.policy.checkpoint import BASIS, PolicyCheckpoint, load_policy
from pipeline.robot.live_features import LiveFeatures, prove
from pipeline.store import FeatureStore
from pipeline.vlm.demo_checkpoint import write_demo_checkpoint
from pipeline.vlm.live import LiveVLM
from pipeline.vlm.preparation import Preparer
from pipeline.vlm.slots import TOLERANCES
from stages import extract, train_head

Frames = Mapping[str, np.ndarray]


@pytest.fixture
def live(params: Params, checkpoint: PolicyCheckpoint) -> LiveFeatures:
    return LiveFeatures(params.vlm, checkpoint.source["feature_spec"], "cpu", None)


def test_live_features_are_the_stored_ones(params, live) -> None:
    store = FeatureStore.open(params.extract.store)
    recording, _ = open_recordings(params.data.sources, params.data.root).recordings
    cameras, times = recording.cameras(), store.array("vl/frame_time")
    rows = np.arange(0, len(store.episodes[0].vl_rows), 3)
    frames: list[dict[str, np.ndarray]] = [{} for _ in rows]
    for place, (view, camera) in enumerate(sorted(cameras.items())):
        shown = np.searchsorted(camera.time, times[rows, place])
        for views, image in zip(frames, camera.read(shown.tolist()), strict=True):
            views[view] = image
    features, valid = live(frames, recording.instruction)
    np.testing.assert_allclose(features, store.array("vl/features")[rows], atol=2e-5)
    assert valid.all()


def test_another_model_is_refused_before_a_weight_is_loaded(params, tmp_path, monkeypatch):
    monkeypatch.setattr(LiveVLM, "load", None)
    trained = FeatureStore.open(params.extract.store).spec
    other = tmp_path / "other"
    write_demo_checkpoint(other)
    (weights,) = other.glob("*.safetensors")
    tensors = load_file(weights)
    name = next(iter(tensors))
    save_file(tensors | {name: tensors[name] * 1.5}, weights, {"format": "pt"})
    vlm = params.vlm.model_copy(update={"checkpoint": str(other)})
    with pytest.raises(CheckpointMismatch, match=r"weights: .* -> "):
        LiveFeatures(vlm, trained, "cpu", None)


def test_the_key_of_frames_is_that_of_the_policys_store(params, live) -> None:
    for row in FeatureStore.open(params.extract.store).golden:
        assert live.key(row.frames, row.instruction) == row.key


def refusal(checkpoint: PolicyCheckpoint, live: LiveFeatures) -> str:
    with pytest.raises(CheckpointMismatch) as refused:
        prove(checkpoint, live, print)
    return str(refused.value)


def broken(monkeypatch: pytest.MonkeyPatch, change: Callable[[Frames], Frames]) -> None:
    """Frames are prepared otherwise than at extraction."""
    real = Preparer.prepare
    monkeypatch.setattr(
        Preparer, "prepare", lambda self, told, frames: real(self, told, change(frames))
    )


def proven(checkpoint: PolicyCheckpoint, live: LiveFeatures) -> tuple[int, float, float]:
    """Of the only line that is said: the rows, the largest deviation and the tolerance."""
    said: list[str] = []
    prove(checkpoint, live, said.append)
    (line,) = said
    found = re.fullmatch(
        r"(\d+) golden rows computed again: the largest deviation is (\S+) of its size "
        r"\(layer .+\), (\S+) is tolerated",
        line,
    )
    assert found, line
    return int(found[1]), float(found[2]), float(found[3])


class TestProven:
    def test_the_very_model(self, checkpoint, live):
        rows, largest, tolerance = proven(checkpoint, live)
        assert rows == len(checkpoint.golden) == 4
        assert tolerance == TOLERANCES["float32"] == 1e-3
        assert 0 <= largest < 1e-5

    def test_another_attention_backend(self, checkpoint, params):
        vlm = params.vlm.model_copy(update={"attention": "eager"})
        live = LiveFeatures(vlm, checkpoint.source["feature_spec"], "cpu", None)
        assert 0 < proven(checkpoint, live)[1] < TOLERANCES["float32"] / 10

    def test_without_golden_rows_there_is_a_warning(self, checkpoint, live):
        said: list[str] = []
        prove(replace(checkpoint, golden=()), live, said.append)
        (warning,) = said
        assert warning.startswith("WARNING: this checkpoint carries no golden rows")


class TestRefused:
    def test_weights_altered_without_the_spec_noticing(self, checkpoint, live):
        with torch.no_grad():
            for weights in live._model.model.language_model.layers[2].mlp.parameters():
                weights.mul_(1.05)
        said = refusal(checkpoint, live)
        assert "4 of 4 golden rows are not the features that the policy was trained on" in said
        assert "layer 3 mean " in said or "layer 3 grid View" in said
        assert "and 43 more" in said

    def test_frames_resized_otherwise_on_the_way_to_the_model(self, checkpoint, live, monkeypatch):
        def blurred(frames: Frames) -> Frames:
            return {v: f[::2, ::2].repeat(2, 0).repeat(2, 1) for v, f in frames.items()}

        broken(monkeypatch, blurred)
        said = refusal(checkpoint, live)
        assert "golden rows are not" in said and " View" in said

    def test_a_view_that_is_lost_on_the_way_to_the_model(self, checkpoint, live, monkeypatch):
        broken(monkeypatch, lambda frames: {v: f for v, f in frames.items() if v != "View5"})
        assert "grid View5 0,0 is missing in one of both" in refusal(checkpoint, live)


def test_half_precision_tolerates_its_own_noise_and_no_more(params, checkpoint, live):
    spec = {**checkpoint.source["feature_spec"], "storage_dtype": "float16"}
    stored = replace(checkpoint, source={**checkpoint.source, "feature_spec": spec})

    def rounded(by: float) -> Any:
        return tuple(
            replace(row, features=(row.features * by).astype(np.float16).astype(np.float32))
            for row in stored.golden
        )

    assert proven(replace(stored, golden=rounded(1.0)), live)[2] == 5e-2
    assert "golden rows are not" in refusal(replace(stored, golden=rounded(1.3)), live)


def test_a_checkpoint_carries_the_basis_on_which_live_features_are_projected(
    params, trained_once, tmp_path, capsys
):
    changed = {
        "extract.store": str(tmp_path / "few.zarr"),
        "extract.dtype": {"pca": 16, "then": "int8"},
        "train_head.output": str(tmp_path / "head"),
        "train_head.logs": str(tmp_path / "logs"),
    }
    few = load_params(
        trained_once, [f"{key}={json.dumps(value)}" for key, value in changed.items()]
    )
    for stage in (extract, train_head):
        stage.main(few)
    assert "16 main directions of 128 numbers; the checkpoint carries" in capsys.readouterr().out
    folder = tmp_path / "head" / "best"
    checkpoint = load_policy(folder)
    live = LiveFeatures(params.vlm, checkpoint.source["feature_spec"], "cpu", checkpoint.basis)
    said: list[str] = []
    prove(checkpoint, live, said.append)
    assert "golden rows computed again" in said[0]
    with pytest.raises(CheckpointMismatch, match="pca"):
        LiveFeatures(params.vlm, checkpoint.source["feature_spec"], "cpu", None)

    save_file({"maps": torch.from_numpy(checkpoint.basis.maps + 1)}, folder / BASIS)
    with pytest.raises(CheckpointIncomplete, match="its digest is not"):
        load_policy(folder)
