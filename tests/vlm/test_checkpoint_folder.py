"""A checkpoint folder comes from anywhere: it is read as it stands, or refused in one message."""

import json
import os

import pytest

from pipeline.base.digests import file_digest
from pipeline.base.errors import VLMError
from pipeline.vlm.checkpoint_folder import resolve_checkpoint
from pipeline.vlm.feature_spec import feature_spec
from pipeline.vlm.preparation import Preparer
from pipeline.vlm.processor import PixelSettings, PromptRenderer
from tests.vlm.documents import edit

MEND = r"Copy or download the checkpoint again, or set vlm\.checkpoint to another"


@pytest.fixture
def spec(vlm_params):
    """What a plan reads of a checkpoint: all but its weights."""

    def read(folder):
        vlm = vlm_params(checkpoint=str(folder))
        return feature_spec(vlm, "float32", ("View1",), file_digest, lambda what, make: make())

    return read


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
        (CONFIG, f"{ROPE}.mrope_section", [8, 8], r"three mrope_section .*found \[8, 8\]"),
        (CONFIG, "image_token_id", -1, r"config\.json.* cannot be read: OverflowError"),
        (PIXELS, "image_std", [0, 1, 1], r"image_std\.0: expected greater than 0, found 0"),
        (PIXELS, "resample", 2, "expected resample 3, found 2"),
        (PIXELS, "patch_size", 7, "expected patch_size 14, found 7"),
        (TOKENS, "tokenizer_class", "Own", "tokenizer_class: .*Qwen2Tokenizer.*'Own'"),
        (TOKENS, "fast_tokenizer_files", ["../a.json"], r"fast_tokenizer_files: .*\.\./a"),
        (TOKENS, "eos_token", 5, r"tokenizer_config\.json cannot be read: .*eos_token"),
        ("processor_config.json", "image_processor", {"patch_size": 14.0}, "patch_size: .* 14.0"),
        (CONFIG, "_attn_implementation", {"text_config": "a/kernel"}, "no code .*_attn_.*a/kernel"),
    ],
)
def test_what_a_file_may_not_say(copy, spec, name, place, value, told):
    edit(copy / name, {place: value})
    with pytest.raises(VLMError, match=rf"(?s){copy}.*{told}.*{MEND}") as refused:
        spec(copy)
    assert len(str(refused.value)) < 1500


@pytest.mark.parametrize(
    ("name", "kind"),
    [(CONFIG, "deep"), ("tokenizer.json", "device"), ("extra.json", "pipe")],
)
def test_a_file_that_is_none_is_never_opened(copy, spec, name, kind):
    path = copy / name
    path.unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.write_text('{"a":' * 100_000 + "1" + "}" * 100_000)
    with pytest.raises(VLMError, match=rf"(?s){copy}.*{name}.*(found a|[Rr]ecursion).*{MEND}"):
        spec(copy)


def test_a_chat_template_that_cannot_be_rendered(copy):
    edit(copy / TOKENS, {"chat_template": "{{ ''.__class__.__mro__ }}"})
    with pytest.raises(VLMError, match=rf"{copy}: .*chat template.*SecurityError.*{MEND}"):
        PromptRenderer(copy, "{instruction}").render("go", 1)


def test_an_index_names_files_of_its_own_folder(copy, spec):
    index = copy / "model.safetensors.index.json"
    shard = (copy / "model.safetensors").rename(copy / "model-1.safetensors")
    outside = f"../{copy.name}/{shard.name}"
    for name, told in ((outside, rf"found '\.\./{copy.name}/"), (str(shard), "")):
        index.write_text(json.dumps({"metadata": {}, "weight_map": {"a": name}}))
        with pytest.raises(VLMError, match=rf"{index}: weight_map\.a: .*{told}.*{MEND}"):
            spec(copy)


PROMPT_MEND = r"Change the instruction in the recording, data\.sources or vlm\.prompt"


@pytest.mark.parametrize(
    ("instruction", "told"),
    [
        ("zq " * 2000, r"1,000 tokens \(max_position_embeddings\), found 12,0.*20 for each"),
        ("a\ud800b", "cannot be cut into tokens"),
    ],
)
def test_a_prompt_is_no_longer_than_the_models_window(copy, vlm_params, instruction, told):
    edit(copy / CONFIG, {"text_config.max_position_embeddings": 1000})
    vlm = vlm_params(checkpoint=str(copy))
    preparer = Preparer(vlm, feature_spec(vlm, "float32", ("View1",), file_digest))
    with pytest.raises(VLMError, match=rf"(?s)^'.*{told}.*{PROMPT_MEND}"):
        preparer.render(instruction, ["View1"])


@pytest.mark.parametrize("name", ["a\0b", "../x", "x" * 5000, "~nobody-here/x"])
def test_a_name_that_is_no_folder_and_no_hub_id(name):
    with pytest.raises(VLMError, match=r"vlm\.adapter .{1,200}: no such folder.*stages\.demo"):
        resolve_checkpoint(name, setting="vlm.adapter")


def test_a_size_is_read_by_either_name(copy):
    for size in ("shortest_edge", "longest_edge"), ("min_pixels", "max_pixels"):
        edit(copy / PIXELS, {"size": dict(zip(size, (3136, 12845056), strict=True))})
        assert PixelSettings.read(copy, (360, 640)).image_size == (364, 644)
    edit(copy / PIXELS, {"max_pixels": 100_000})
    assert PixelSettings.read(copy, (360, 640)).image_size == (224, 420)
