"""Statistics, samples and the prompt say what the recording and training say."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.base.config import Params, VLMParams
from pipeline.base.digests import ContentDigests
from pipeline.base.errors import RecordingError, VLMError
from pipeline.datasets import UnifiedVLADataset
from pipeline.look.recording.facts import EpisodeView
from pipeline.look.recording.prompt import view_prompt
from pipeline.look.recording.samples import samples
from pipeline.look.recording.statistics import channel_statistics, statistics_of
from pipeline.vlm.feature_spec import FeatureSpec, feature_spec

Look = Callable[..., EpisodeView]


@pytest.fixture
def params() -> Params:
    return Params.model_validate(
        {
            "data": {"sources": [{"name": "s", "path": "."}]},
            "vlm": {"checkpoint": "none"},
            "train_head": {"horizon": 6, "sensor_window": 40, "state_window": 30},
        }
    )


@pytest.mark.parametrize("format", ["raw", "new", "old", "lerobot"])
def test_samples_are_those_of_training(healthy: Path, look: Look, params: Params, format: str):
    view = look(healthy / format)
    assert view.timeline is not None
    dataset, batch = samples(view, params, 5, seed=0)
    ticks = len(view.timeline.time)
    assert len(dataset) == ticks and len(batch) == 5
    assert batch.tick[0] == 0 and batch.tick[-1] == ticks - 1
    assert len(set(batch.tick.tolist())) == 5 and (batch.tick.diff() > 0).all()
    assert batch.state_valid[0] < 30 and batch.action_valid[-1].tolist() == [1, 0, 0, 0, 0, 0]
    whole = UnifiedVLADataset(
        healthy / format,
        horizon=6,
        sensor_window_size=40,
        state_window_size=30,
        action_rotation=view.action_rotation,
    )
    expected = whole.__getitems__(batch.tick.tolist())
    for name in ("time", "sensor", "state", "action", "feature_age"):
        assert torch.equal(getattr(batch, name), getattr(expected, name)), name
    assert batch.images is not None and expected.images is not None
    for ours, theirs in zip(batch.images, expected.images, strict=True):
        assert ours.keys() == theirs.keys()
        assert all(np.array_equal(ours[name], theirs[name]) for name in ours)


def test_samples_follow_the_seed_and_are_never_more_than_ticks(
    healthy: Path, look: Look, params: Params
) -> None:
    view = look(healthy / "old")
    assert view.timeline is not None
    ticks = [samples(view, params, 4, seed)[1].tick.tolist() for seed in (1, 1, 2)]
    assert ticks[0] == ticks[1] != ticks[2]
    assert samples(view, params, 1, 0)[1].tick.tolist() == [0]
    assert len(samples(view, params, 10_000, 0)[1]) == len(view.timeline.time)


@pytest.mark.parametrize("channels", [1, 2, 17])
def test_statistics_leave_the_values_as_they_are(channels: int) -> None:
    values = np.random.default_rng(0).normal(size=(50, channels)).astype(np.float32)
    before = values.copy()
    names = [f"c{index}" for index in range(channels)]
    assert len(list(statistics_of("state", names, names, values))) == channels
    assert np.array_equal(values, before)


def test_statistics_of_every_channel(healthy: Path, look: Look) -> None:
    view = look(healthy / "raw")
    found = {(one.stream, one.name): one for one in channel_statistics(view)}
    assert view.sensor is not None and view.state is not None and view.timeline is not None
    # Poses are columns of the state.
    assert len(found) == 1026 + 12 + 7
    force = view.sensor.values[:, 0].astype(np.float64)
    one = found["sensor", "force"]
    assert (one.unit, one.count) == ("N", len(force))
    assert (one.minimum, one.maximum) == (force.min(), force.max())
    assert one.median == np.median(force) and one.mean == pytest.approx(force.mean())
    assert one.std == pytest.approx(force.std())
    assert (one.low, one.high) == pytest.approx(tuple(np.percentile(force, [1, 99])))
    scan = found["sensor", "aline_0700"]
    assert scan.mean == pytest.approx(view.sensor.values[:, 701].mean(dtype=np.float64))
    assert found["action", "dx"].maximum == view.timeline.action[:, 0].max()


class TestPrompt:
    @pytest.fixture
    def vlm(self, demo_checkpoint: Path) -> VLMParams:
        return VLMParams(
            checkpoint=str(demo_checkpoint), image_resize_height=56, image_resize_width=84
        )

    @pytest.fixture
    def spec(self, vlm: VLMParams, tmp_path: Path) -> FeatureSpec:
        digests = ContentDigests(tmp_path / "digests.json")
        return feature_spec(vlm, "float32", ["View1", "View2", "View5"], digests.of)

    def test_it_is_what_the_model_gets(self, healthy: Path, look: Look, vlm, spec) -> None:
        view = look(healthy / "old")
        prompt = view_prompt(view, vlm, spec)
        assert prompt.instruction == view.instruction and prompt.instruction in prompt.text
        assert prompt.pixels == (56, 84)
        # 14-pixel patches, merged two by two.
        assert prompt.image_tokens == {"View1": 6, "View2": 6, "View5": 6}
        assert list(prompt.image_tokens) == ["View1", "View2", "View5"]
        assert prompt.special["<|vision_start|>"] == prompt.special["<|vision_end|>"] == 3
        assert prompt.special["<|image_pad|>"] == 18
        assert prompt.special["<|im_start|>"] == prompt.text.count("<|im_start|>")
        images = [token for token in prompt.tokens if token.kind == "image"]
        assert len(images) == 18 and {token.view for token in images[:6]} == {"View1"}
        shrunk, last = "", None
        for token in prompt.tokens:
            shrunk += "" if token.kind == "image" and token.view == last else token.text
            last = token.view
        assert shrunk == prompt.text

    def test_a_letter_of_several_tokens_is_spelled_out(self, healthy, look, vlm, spec) -> None:
        view = replace(look(healthy / "old"), instruction="바늘")
        prompt = view_prompt(view, vlm, spec)
        assert "바늘" in prompt.text
        assert all("\ufffd" not in token.text and token.text for token in prompt.tokens)

    def test_what_stands_in_its_way(self, healthy, look: Look, vlm: VLMParams, spec) -> None:
        view = look(healthy / "old")
        with pytest.raises(VLMError, match="no such folder"):
            view_prompt(view, vlm.model_copy(update={"checkpoint": "./none"}), spec)
        with pytest.raises(VLMError, match="control token"):
            view_prompt(replace(view, instruction="<|im_end|>"), vlm, spec)
        with pytest.raises(RecordingError, match="instruction cannot be read"):
            view_prompt(replace(view, instruction=None), vlm, spec)
        with pytest.raises(RecordingError, match="has no tick"):
            view_prompt(replace(view, timeline=None), vlm, spec)
