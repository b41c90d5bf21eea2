"""The prompt is what the model gets, and its spec is found without reading files again."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.base import digests
from pipeline.base.config import Params, VLMParams, load_params
from pipeline.base.digests import ContentDigests
from pipeline.base.errors import RecordingError, VLMError
from pipeline.base.files import MARKER
from pipeline.base.table import Table
from pipeline.look.page.blocks import Text, Tokens
from pipeline.look.recording.episode import EpisodeView
from pipeline.look.recording.model_input import (
    LEDGER,
    describe_stretch,
    digest_ledger,
    fold_tokens,
    remembered_spec,
    show_prompt,
)
from pipeline.vlm.feature_spec import FeatureSpec, feature_spec
from pipeline.vlm.preparation import Preparer
from pipeline.vlm.processor import TokenKind

Look = Callable[..., EpisodeView]
PARAMS = Path(__file__).resolve().parents[3] / "params.yaml"


@pytest.fixture
def params(demo_checkpoint: Path, tmp_path: Path) -> Params:
    return load_params(
        PARAMS,
        [
            f"vlm.checkpoint={demo_checkpoint}",
            f"inspect.output={tmp_path / 'pages'}",
            f"extract.store={tmp_path / 'stores' / 'one.zarr'}",
        ],
    )


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The files whose content is read for a digest."""
    found: list[Path] = []
    really: Callable[[Path], str] = digests.file_digest

    def counted(path: Path) -> str:
        found.append(path)
        return really(path)

    monkeypatch.setattr(digests, "file_digest", counted)
    return found


def test_a_checkpoint_is_read_once(params: Params, read: list[Path], tmp_path: Path) -> None:
    first = remembered_spec(params, ["View1"])
    assert any(path.suffix == ".safetensors" for path in read)
    read.clear()
    assert remembered_spec(params, ["View1"]) == first
    assert read == []
    made = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert made == {MARKER, LEDGER}


def test_what_extraction_has_read_is_not_read_again(
    params: Params, read: list[Path], tmp_path: Path
) -> None:
    ledger = tmp_path / "stores" / "one.zarr.files.sqlite"
    known = digests.ContentDigests(ledger)
    for path in params_files(params):
        known.of(path)
    known.close()
    read.clear()
    assert digest_ledger(params) == ledger
    remembered_spec(params, ["View1"])
    assert read == [] and not (tmp_path / "pages").exists()


def params_files(params: Params) -> list[Path]:
    return [path for path in Path(params.vlm.checkpoint).iterdir() if path.is_file()]


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
