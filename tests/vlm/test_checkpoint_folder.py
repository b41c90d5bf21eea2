"""A checkpoint folder comes from anywhere: it is read as it stands, or refused in one message."""

import json
import os
import shutil
from collections.abc import Callable
from typing import Any

import pytest

from pipeline.base.digests import file_digest
from pipeline.base.errors import VLMError
from pipeline.vlm.checkpoint_folder import read_config, resolve_checkpoint
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
    document = json.loads(path.read_text())
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
        (CONFIG, "vision_config.window_size", None, "window_size.*got NoneType"),
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
        (PIXELS, "image_processor_type", "CLIP", "image_processor_type .*found 'CLIP'"),
        (PIXELS, "patch_size", 7, "expected patch_size 14, found 7"),
        (TOKENS, "tokenizer_class", "Own", "tokenizer_class: .*Qwen2Tokenizer.*'Own'"),
        (TOKENS, "eos_token", 5, r"tokenizer_config\.json cannot be read: .*eos_token"),
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
        (CONFIG, "folder"),
        (CONFIG, "deep"),
        (PIXELS, "device"),
        (TOKENS, "pipe"),
        ("tokenizer.json", "device"),
        ("extra.json", "pipe"),
    ],
)
def test_a_file_that_is_none_is_never_opened(folder, spec, name, kind):
    path = folder / name
    path.unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
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
    for weight_map, told in (
        (
            {"a": "../vlm/model.safetensors"},
            r"weight_map\.a: .*found '\.\./vlm/model\.safetensors'",
        ),
        ({"a": str(folder / "model.safetensors")}, r"weight_map\.a: "),
        ({"a": 5}, r"weight_map\.a: expected a valid string, found 5"),
        ([1], r"weight_map: expected an object, found \[1\]"),
    ):
        index.write_text(json.dumps({"metadata": {}, "weight_map": weight_map}))
        with pytest.raises(VLMError, match=rf"{index}: {told}.*{MEND}"):
            spec(folder)


def test_merges_that_are_cut_off_are_not_taken_for_whole(folder, spec):
    whole = json.loads((folder / "tokenizer.json").read_text())
    (folder / "tokenizer.json").unlink()
    (folder / "vocab.json").write_text(json.dumps(whole["model"]["vocab"]))
    merges = ["#version: 0.2", *map(" ".join, whole["model"]["merges"])]
    (folder / "merges.txt").write_text("\n".join(merges))
    spec(folder)
    (folder / "merges.txt").write_text("\n".join(merges[:300]))
    with pytest.raises(VLMError, match=rf"merges are cut off: expected 632.*299\. {MEND}"):
        spec(folder)


def test_no_kernel_is_fetched(folder, spec):
    for key in ("attn_implementation", "_attn_implementation", "_experts_implementation"):
        _edit(folder / CONFIG, key, {"": "sdpa", "text_config": "someone/kernel"})
        with pytest.raises(VLMError, match=rf"config\.json: .*no code .*found {key} .*e/kernel"):
            spec(folder)
        _edit(folder / CONFIG, key, ...)


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
    for setting in ("vlm.checkpoint", "vlm.adapter"):
        with pytest.raises(VLMError, match=rf"{setting} .{{1,200}}: no such folder.*stages\.demo"):
            resolve_checkpoint(name, setting=setting)


FLAT: dict[str, Any] = {
    "hidden_size": 2048,
    "intermediate_size": 11008,
    "max_position_embeddings": 128000,
    "max_window_layers": 70,
    "model_type": "qwen2_5_vl",
    "num_attention_heads": 16,
    "num_hidden_layers": 36,
    "num_key_value_heads": 2,
    "rms_norm_eps": 1e-06,
    "rope_theta": 1000000.0,
    "sliding_window": 32768,
    "use_sliding_window": False,
    "image_token_id": 151655,
    "rope_scaling": {"type": "mrope", "mrope_section": [16, 24, 24]},
    "vocab_size": 151936,
    "vision_config": {
        "depth": 32,
        "hidden_size": 1280,
        "in_chans": 3,
        "num_heads": 16,
        "out_hidden_size": 2048,
        "spatial_patch_size": 14,
        "window_size": 112,
        "fullatt_block_indexes": [7, 15, 23, 31],
        "tokens_per_second": 2,
    },
}
"""As the hub has it."""


def test_what_the_hub_and_older_versions_write_is_read(folder):
    config_of_the_folder = (folder / CONFIG).read_text()
    short = {"hidden_size": 1280, "in_chans": 3, "model_type": "qwen2_5_vl"}
    text = {**FLAT, "model_type": "qwen2_5_vl_text", "image_token_id": None}
    text["rope_scaling"] = {"mrope_section": [16, 24, 24], "rope_type": "default"}
    for document in (FLAT, FLAT | {"vision_config": short}, FLAT | {"text_config": text}):
        (folder / CONFIG).write_text(json.dumps(document))
        config = read_config(folder)
        assert (config.text_config.hidden_size, config.text_config.num_hidden_layers) == (2048, 36)
        assert tuple(config.vision_config.fullatt_block_indexes) == (7, 15, 23, 31)
        assert config.image_token_id == 151655
    (folder / CONFIG).write_text(config_of_the_folder)
    for size in ("shortest_edge", "longest_edge"), ("min_pixels", "max_pixels"):
        _edit(folder / PIXELS, "size", dict(zip(size, (3136, 12845056), strict=True)))
        assert PixelSettings.read(folder, (360, 640)).image_size == (364, 644)
    _edit(folder / PIXELS, "max_pixels", 100_000)
    assert PixelSettings.read(folder, (360, 640)).image_size == (224, 420)


@pytest.mark.parametrize(
    ("name", "place", "value", "told"),
    [
        ("preprocessor_config.json", "max_pixels", "x", r"longest_edge: .* found 'x'"),
        ("preprocessor_config.json", "image_std", ["1", "1", "1"], "image_std.0: .* found '1'"),
        ("processor_config.json", "image_processor", {"patch_size": 14.0}, "patch_size: .* 14.0"),
    ],
)
def test_pixel_settings_of_a_wrong_type_are_refused_in_their_file(
    demo_checkpoint, tmp_path, name, place, value, told
):
    path = shutil.copytree(demo_checkpoint, tmp_path / "vlm") / name
    document = json.loads(path.read_text()) if path.exists() else {}
    path.write_text(json.dumps(document | {place: value}))
    with pytest.raises(VLMError, match=rf"/{name}: .*{told}"):
        PixelSettings.read(path.parent, (112, 140))


def test_a_config_without_a_value_that_decides_features_is_refused(folder):
    whole = (folder / CONFIG).read_text()
    text = ("hidden_size", "num_hidden_layers", "rms_norm_eps", "max_position_embeddings")
    vision = ("num_heads", "fullatt_block_indexes")
    for part, keys in (("text_config", text), ("vision_config", vision)):
        for key in keys:
            (folder / CONFIG).write_text(whole)
            _edit(folder / CONFIG, f"{part}.{key}", ...)
            with pytest.raises(VLMError, match=rf"config\.json: {part}.*(: missing|{key})"):
                read_config(folder)


def test_no_tokenizer_file_of_another_folder_is_read(demo_checkpoint, tmp_path):
    path = shutil.copytree(demo_checkpoint, tmp_path / "vlm") / "tokenizer_config.json"
    elsewhere = {"fast_tokenizer_files": ["../other/tokenizer.4.0.0.json"]}
    path.write_text(json.dumps(json.loads(path.read_text()) | elsewhere))
    with pytest.raises(VLMError, match=r"fast_tokenizer_files: .*\.\./other"):
        PromptRenderer(path.parent, "{instruction}{images}")
