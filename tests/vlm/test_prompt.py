"""Prompts are one user turn of the checkpoint's chat template."""

import json
from typing import Any

import pytest
from transformers import AutoTokenizer

from pipeline.base.errors import VLMError
from pipeline.vlm.processor import PromptRenderer
from tests.vlm.documents import edit

SYSTEM = "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n"
IMAGE = "<|vision_start|><|image_pad|><|vision_end|>"


@pytest.mark.parametrize(
    ("template", "images", "user"),
    [
        ("{instruction}\n{images}\n{instruction}", 2, f"go\n{IMAGE * 2}\ngo"),
        ("{instruction}\n{images}\n{instruction}", 0, "go\n\ngo"),
        ("Task: {instruction}.", 3, f"Task: go.{IMAGE * 3}"),
    ],
)
def test_rendering(demo_checkpoint, template, images, user):
    renderer = PromptRenderer(demo_checkpoint, template)
    assert renderer.render("go", images) == f"{SYSTEM}<|im_start|>user\n{user}<|im_end|>\n"


def test_an_instruction_is_never_a_template(demo_checkpoint):
    renderer = PromptRenderer(demo_checkpoint, "{instruction} {images}")
    text = renderer.render("look at {images} and {instruction} {{ 1 }}", 1)
    assert "look at {images} and {instruction} {{ 1 }}" in text
    assert text.count(IMAGE) == 1


@pytest.mark.parametrize("token", ["<|image_pad|>", "<|box_start|>"])
def test_control_tokens_are_refused(demo_checkpoint, token):
    renderer = PromptRenderer(demo_checkpoint, "{instruction}")
    with pytest.raises(VLMError, match="control token"):
        renderer.render(f"go {token} there", 1)
    with pytest.raises(VLMError, match=r"vlm\.prompt holds"):
        PromptRenderer(demo_checkpoint, f"{{instruction}}{token}")


def test_a_token_is_described_by_its_text_and_its_kind(demo_checkpoint):
    renderer = PromptRenderer(demo_checkpoint, "{instruction} {images}")
    text = renderer.render("바늘 in", 1)
    described = [renderer.describe(token) for token in renderer.tokenize(text)]
    assert ("<|im_start|>", "special") in described and ("<|image_pad|>", "image") in described
    assert all("\ufffd" not in said for said, _ in described)
    words = "".join(said for said, kind in described if kind == "text")
    assert words.startswith("system\nYou are") and " in " in words


def test_tokens_are_the_tokenizers_with_one_placeholder_a_merged_patch(
    demo_checkpoint, extractor, make_frame
):
    preparer = extractor().preparer
    row = preparer.prepare("insert the needle", {"View3": make_frame(1), "View1": make_frame(2)})
    tokenizer: Any = AutoTokenizer.from_pretrained(demo_checkpoint)
    text = row.prompt.replace("<|image_pad|>", "<|image_pad|>" * 20)
    assert row.token_ids.tolist() == tokenizer(text)["input_ids"]
    assert [view for view, _ in row.layout.image_starts] == ["View1", "View3"]
    pad = tokenizer.convert_tokens_to_ids("<|image_pad|>")
    assert (row.token_ids[row.layout.image_tokens()] == pad).all()
    assert (row.token_ids == pad).sum() == 40
    assert row.prompt == preparer.render("insert the needle", ["View3", "View1"])


def test_chat_template_in_a_file_of_its_own(demo_checkpoint, copy):
    inside = PromptRenderer(demo_checkpoint, "{instruction}")
    edit(copy / "tokenizer_config.json", {"chat_template": None})
    with pytest.raises(VLMError, match="no chat template"):
        PromptRenderer(copy, "{instruction}")
    for name, content in (
        ("chat_template.json", json.dumps({"chat_template": inside.chat_template})),
        ("chat_template.jinja", inside.chat_template),
    ):
        (copy / name).write_text(content)
        assert PromptRenderer(copy, "{instruction}").render("go", 1) == inside.render("go", 1)
        (copy / name).unlink()


def test_a_template_that_drops_images_is_refused(copy):
    edit(copy / "tokenizer_config.json", {"chat_template": "{{ messages[0]['role'] }}"})
    with pytest.raises(VLMError, match="renders 0 of 2 images"):
        PromptRenderer(copy, "{instruction}").render("go", 2)


def test_another_checkpoints_tokenizer_is_refused(copy):
    edit(copy / "config.json", {"image_token_id": 5})
    with pytest.raises(VLMError, match="image_token_id 5"):
        PromptRenderer(copy, "{instruction}")
    (copy / "tokenizer.json").unlink()
    with pytest.raises(VLMError, match="no tokenizer"):
        PromptRenderer(copy, "{instruction}")
