"""The prompt on the page is what the model gets."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.base.config import VLMParams
from pipeline.base.errors import RecordingError, VLMError
from pipeline.base.text import Table
from pipeline.look.page.blocks import Text, Tokens
from pipeline.look.recording.episode import EpisodeView
from pipeline.look.recording.samples import describe_stretch, fold_tokens, show_prompt
from pipeline.vlm.feature_spec import FeatureSpec, feature_spec
from pipeline.vlm.preparation import Preparer
from pipeline.vlm.processor import TokenKind

Look = Callable[..., EpisodeView]


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
        assert [(row[0], row[2], row[4]) for row in sizes.rows] == [
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

    def test_a_letter_of_several_tokens_is_spelled_out(self, healthy, look, vlm, spec) -> None:
        view = replace(look(healthy / "old"), instruction="바늘")
        _, prompt, *_ = show_prompt(view, vlm, spec)
        assert isinstance(prompt, Tokens)
        assert all(run.text and "\ufffd" not in run.text for run in prompt.runs)

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


def test_what_the_model_sees_in_another_shape_is_said() -> None:
    assert describe_stretch((720, 1280), (364, 644)) is None
    assert describe_stretch((480, 640), (364, 644)) == "33% in width"
    assert describe_stretch((720, 1280), (200, 200)) == "78% in height"


def test_image_tokens_are_folded_view_by_view() -> None:
    tokens: list[tuple[str, TokenKind, str | None]] = [
        *(("<s>", "special", None), ("<e>", "special", None), ("a", "text", None)),
        *(("b", "text", None), *[("<i>", "image", "View1")] * 3, ("<i>", "image", "View2")),
    ]
    assert [(run.text, run.kind, run.note) for run in fold_tokens(tokens)] == [
        ("<s>", "special", ""),
        ("<e>", "special", ""),
        ("ab", "text", ""),
        ("<i>", "image", "× 3, View1"),
        ("<i>", "image", "× 1, View2"),
    ]
