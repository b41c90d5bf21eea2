"""A checkpoint folder comes from anywhere: it is read as it stands, or refused in one message."""

import json
import os
import shutil
from collections.abc import Callable

import pytest

from pipeline.base.digests import file_digest
from pipeline.base.errors import VLMError
from pipeline.vlm.checkpoint_folder import resolve_checkpoint
from pipeline.vlm.feature_spec import feature_spec
from pipeline.vlm.preparation import Preparer
from pipeline.vlm.processor import PixelSettings, PromptRenderer

MEND = r"Copy or download the checkpoint again, or set vlm\.checkpoint to another"

Spec = Callable[..., object]


@pytest.fixture
def folder(demo_checkpoint, tmp_path):
    return shutil.copytree(demo_checkpoint, tmp_path / "vlm")


@pytest.fixture
def spec(vlm_params):
    """What a plan reads of a checkpoint: all but its weights."""

    def read(folder):
        vlm = vlm_params(checkpoint=str(folder))
        return feature_spec(vlm, "float32", ("View1",), file_digest, lambda what, make: make())

    return read


def _edit(path, place, value):
    document = json.loads(path.read_text()) if path.exists() else {}
    *outer, last = place.split(".")
    inside = document
    for key in outer:
        inside = inside[key]
    inside.pop(last, None)
    if value is not ...:
        inside[last] = value
    path.write_text(json.dumps(document))


CONFIG = "config.json"
PIXELS = "preprocessor_config.json"
TOKENS = "tokenizer_config.json"
ROPE = "text_config.rope_parameters"


@pytest.mark.parametrize(
    ("name", "place", "value", "told"),
    [
        (CONFIG, "model_type", ["qwen2_5_vl"], r"model_type: expected 'qwen2_5_vl', found \["),
        (CONFIG, "vision_config.num_heads", 7, "4 x num_heads 7 to divide"),
        (CONFIG, "vision_config.window_size", 0, "window_size 0 of 28 or more"),
        (CONFIG, "vision_config.fullatt_block_indexes", [4], r"\[4\] below depth 4"),
        (CONFIG, "text_config.head_dim", 16, "head_dim to be 32"),
        (
            CONFIG,
            f"{ROPE}.mrope_section",
            [8, 8],
            r"three mrope_section .*found \[8, 8\]",
        ),
        (CONFIG, "image_token_id", -1, r"config\.json.* cannot be read: OverflowError"),
        (PIXELS, "image_std", [0, 1, 1], r"image_std\.0: expected greater than 0, found 0"),
        (PIXELS, "resample", 2, "expected resample 3, found 2"),
        (PIXELS, "patch_size", 7, "expected patch_size 14, found 7"),
        (TOKENS, "tokenizer_class", "Own", "tokenizer_class: .*Qwen2Tokenizer.*'Own'"),
        (TOKENS, "eos_token", 5, r"tokenizer_config\.json cannot be read: .*eos_token"),
        ("processor_config.json", "image_processor", {"patch_size": 14.0}, "patch_size: .* 14.0"),
    ],
)
def test_what_a_file_may_not_say(folder, spec, name, place, value, told):
    _edit(folder / name, place, value)
    with pytest.raises(VLMError, match=rf"(?s){folder}.*{told}.*{MEND}") as refused:
        spec(folder)
    assert len(str(refused.value)) < 1500


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        (CONFIG, "pipe"),
        (CONFIG, "deep"),
        (PIXELS, "device"),
        ("tokenizer.json", "device"),
        ("extra.json", "pipe"),
    ],
)
def test_a_file_that_is_none_is_never_opened(folder, spec, name, kind):
    path = folder / name
    path.unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.write_text('{"a":' * 100_000 + "1" + "}" * 100_000)
    with pytest.raises(VLMError, match=rf"(?s){folder}.*{name}.*(found a|[Rr]ecursion).*{MEND}"):
        spec(folder)


@pytest.mark.parametrize(
    ("template", "told"),
    [
        ("{{ ''.__class__.__mro__ }}", "SecurityError"),
        ("{{ " + "(" * 5000 + "1" + ")" * 5000 + " }}", "RecursionError"),
    ],
)  # fmt: skip
def test_a_chat_template_that_cannot_be_rendered(folder, template, told):
    _edit(folder / TOKENS, "chat_template", template)
    with pytest.raises(VLMError, match=rf"{folder}: .*chat template.*{told}.*{MEND}"):
        PromptRenderer(folder, "{instruction}").render("go", 1)


def test_an_index_names_files_of_its_own_folder(folder, spec):
    index = folder / "model.safetensors.index.json"
    shard = (folder / "model.safetensors").rename(folder / "model-1.safetensors")
    for name, told in (("../vlm/model-1.safetensors", r"found '\.\./vlm/"), (str(shard), "")):
        index.write_text(json.dumps({"metadata": {}, "weight_map": {"a": name}}))
        with pytest.raises(VLMError, match=rf"{index}: weight_map\.a: .*{told}.*{MEND}"):
            spec(folder)


def test_no_kernel_is_fetched(folder, spec):
    _edit(folder / CONFIG, "_attn_implementation", {"": "sdpa", "text_config": "someone/kernel"})
    with pytest.raises(VLMError, match=r"config\.json: .*no code .*_attn_impl.* .*e/kernel"):
        spec(folder)


PROMPT_MEND = r"Change the instruction in the recording, data\.sources or vlm\.prompt"


@pytest.mark.parametrize(
    ("instruction", "told"),
    [
        (
            "zq " * 2000,
            r"at most 1,000 tokens \(max_position_embeddings\), found 12,0.*20 for each",
        ),
        ("a\ud800b", "cannot be cut into tokens"),
    ],
)
def test_a_prompt_is_no_longer_than_the_models_window(folder, vlm_params, instruction, told):
    _edit(folder / CONFIG, "text_config.max_position_embeddings", 1000)
    vlm = vlm_params(checkpoint=str(folder))
    preparer = Preparer(vlm, feature_spec(vlm, "float32", ("View1",), file_digest))
    with pytest.raises(VLMError, match=rf"(?s)^'.*{told}.*{PROMPT_MEND}"):
        preparer.render(instruction, ["View1"])


@pytest.mark.parametrize(
    "name",
    ["a\0b", "../x", "x" * 5000, "~nobody-here/x"],
)
def test_a_name_that_is_no_folder_and_no_hub_id(name):
    with pytest.raises(VLMError, match=r"vlm\.adapter .{1,200}: no such folder.*stages\.demo"):
        resolve_checkpoint(name, setting="vlm.adapter")


def test_a_size_is_read_by_either_name(folder):
    for size in ("shortest_edge", "longest_edge"), ("min_pixels", "max_pixels"):
        _edit(folder / PIXELS, "size", dict(zip(size, (3136, 12845056), strict=True)))
        assert PixelSettings.read(folder, (360, 640)).image_size == (364, 644)
    _edit(folder / PIXELS, "max_pixels", 100_000)
    assert PixelSettings.read(folder, (360, 640)).image_size == (224, 420)


def test_no_tokenizer_file_of_another_folder_is_read(demo_checkpoint, tmp_path):
    path = shutil.copytree(demo_checkpoint, tmp_path / "vlm") / "tokenizer_config.json"
    elsewhere = {"fast_tokenizer_files": ["../other/tokenizer.4.0.0.json"]}
    path.write_text(json.dumps(json.loads(path.read_text()) | elsewhere))
    with pytest.raises(VLMError, match=r"fast_tokenizer_files: .*\.\./other"):
        PromptRenderer(path.parent, "{instruction}{images}")
