"""Samples are those of training, and the prompt on the page is what the model gets."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.base.config import Params, VLMParams
from pipeline.base.errors import RecordingError, VLMError
from pipeline.base.text import Table
from pipeline.datasets import UnifiedVLADataset
from pipeline.look.page.blocks import Text, Tokens
from pipeline.look.recording.episode import LoadedRecording
from pipeline.look.recording.samples import (
    Sample,
    batch_table,
    cut_samples,
    show_prompt,
    window_lengths,
)
from pipeline.vlm.feature_spec import FeatureSpec, feature_spec
from pipeline.vlm.preparation import Preparer

Look = Callable[..., LoadedRecording]
WINDOWS = {"horizon": 6, "sensor_window": 40, "state_window": 30}


def params_of(samples: int, seed: int = 0, **head: int) -> Params:
    return Params.model_validate(
        {
            "data": {"sources": [{"name": "s", "path": "."}]},
            "vlm": {"checkpoint": "none"},
            "train_head": WINDOWS | head,
            "inspect": {"samples": samples, "seed": seed},
        }
    )


@pytest.mark.parametrize("format", ["raw", "new", "old", "lerobot"])
def test_samples_are_those_of_training(healthy: Path, look: Look, format: str) -> None:
    view = look(healthy / format)
    assert view.timeline is not None
    samples = cut_samples(view, params_of(5))
    ticks = [sample.tick for sample in samples]
    assert ticks[0] == 0 and ticks[-1] == len(view.timeline.time) - 1
    assert len(set(ticks)) == 5 and ticks == sorted(ticks)
    assert len(samples[0].windows["state"]) < 30 and len(samples[-1].windows["action"]) == 1
    dataset = UnifiedVLADataset(
        healthy / format,
        horizon=6,
        sensor_window_size=40,
        state_window_size=30,
        action_rotation=view.action_rotation,
    )
    batch = dataset.__getitems__(ticks)
    assert batch.images is not None
    for place, sample in enumerate(samples):
        for name in ("sensor", "state"):
            valid = int(getattr(batch, f"{name}_valid")[place])
            window = getattr(batch, name)[place].numpy()
            assert len(sample.windows[name]) == valid
            assert np.array_equal(sample.windows[name], window[len(window) - valid :])
        chunk = batch.action[place].numpy()[batch.action_valid[place].numpy().astype(bool)]
        assert np.array_equal(sample.windows["action"], chunk)
        assert sample.frames.keys() == batch.images[place].keys()
        for name, frame in sample.frames.items():
            assert np.array_equal(frame, batch.images[place][name])


@pytest.fixture(scope="module")
def params() -> Params:
    return params_of(3, sensor_window=65, state_window=20, horizon=4)


@pytest.fixture(scope="module")
def samples(view: LoadedRecording, params: Params) -> list[Sample]:
    """The first tick, one within, and the last."""
    return cut_samples(view, params)


def test_a_batch_tells_real_from_padded_and_masked(samples: list[Sample], params: Params) -> None:
    table = batch_table(samples, window_lengths(params))
    real = [[len(sample.windows[name]) for name in samples[0].windows] for sample in samples]
    assert real[0][0] < 65 and real[2][2] == 1
    assert [list(row) for row in table.rows] == [
        [sample.tick, f"{sensor} of 65", f"{state} of 20", f"{action} of 4"]
        for sample, (sensor, state, action) in zip(samples, real, strict=True)
    ]


class TestPrompt:
    @pytest.fixture
    def vlm(self, demo_checkpoint: Path) -> VLMParams:
        return VLMParams(
            checkpoint=str(demo_checkpoint), image_resize_height=56, image_resize_width=84
        )

    @pytest.fixture
    def spec(self, vlm: VLMParams) -> FeatureSpec:
        return feature_spec(vlm, "float32", ["View1", "View2", "View5"], lambda path: "")

    def test_it_is_what_the_model_gets(self, healthy: Path, look: Look, vlm, spec) -> None:
        view = look(healthy / "old")
        text, prompt, sizes = show_prompt(view, vlm, spec)
        assert isinstance(text, Text) and isinstance(prompt, Tokens)
        assert isinstance(sizes, Table)
        words = "".join(run.text for run in prompt.runs)
        assert view.instruction is not None and view.instruction in words
        # 14-pixel patches, merged two by two.
        assert [(row[0], row[2], row[3]) for row in sizes.rows] == [
            (name, "56 × 84", 6) for name in ("View1", "View2", "View5")
        ]
        assert "18 of images" in text.words
        named = [run.text for run in prompt.runs if run.kind == "special"]
        assert named.count("<|vision_start|>") == named.count("<|vision_end|>") == 3
        assert named.count("<|im_start|>") == words.count("<|im_start|>")
        images = [run.note for run in prompt.runs if run.kind == "image"]
        assert images == ["× 6, View1", "× 6, View2", "× 6, View5"]
        # The folded tokens are the rendered prompt, with one placeholder an image.
        assert words == Preparer(vlm, spec).render(view.instruction, list(view.cameras))

    def test_what_stands_in_its_way(self, healthy, look: Look, vlm: VLMParams, spec) -> None:
        view = look(healthy / "old")
        with pytest.raises(VLMError, match="no such folder"):
            show_prompt(view, vlm.model_copy(update={"checkpoint": "./none"}), spec)
        with pytest.raises(VLMError, match="control token"):
            show_prompt(replace(view, instruction="<|im_end|>"), vlm, spec)
        with pytest.raises(RecordingError, match="has no instruction"):
            show_prompt(replace(view, instruction=None), vlm, spec)
        with pytest.raises(RecordingError, match="no tick"):
            show_prompt(replace(view, timeline=None), vlm, spec)
