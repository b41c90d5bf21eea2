"""Every weight is accounted for, whatever the checkpoint's naming, with an adapter or without."""

import io
import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest
import torch
from peft import LoraConfig, PeftModel, get_peft_model
from safetensors.torch import load_file, save_file
from transformers import Qwen2_5_VLForConditionalGeneration

from pipeline.base.config import VLMParams
from pipeline.base.digests import file_digest
from pipeline.base.errors import ConfigError, VLMError
from pipeline.vlm.feature_spec import feature_spec
from pipeline.vlm.loading import load_model
from pipeline.vlm.processor import PixelSettings, PromptRenderer
from tests.vlm.documents import edit

# peft 0.21 reads an attribute that transformers 5.23 calls deprecated.
pytestmark = pytest.mark.filterwarnings("ignore:`is_gradient_checkpointing`:FutureWarning")


@pytest.fixture(scope="module")
def encode(extractor, make_frame):
    """Features of one row under changed params."""
    frames = {view: make_frame(seed) for seed, view in enumerate(("View1", "View2", "View3"))}

    def features(**changes):
        ours = extractor(pooling=["mean", "view_mean"], **changes)
        return ours.model.encode([ours.preparer.prepare("insert the needle", frames)])[0]

    return features


def _rewrite(folder, change):
    path = folder / "model.safetensors"
    weights = {name: tensor.contiguous() for name, tensor in change(load_file(path)).items()}
    save_file(weights, path, metadata={"format": "pt"})


def _with_head(weights):
    return weights | {"lm_head.weight": weights["model.embed_tokens.weight"].clone()}


def _newer_names(weights):
    def rename(name):
        if name.startswith("visual."):
            return f"model.{name}"
        return name.replace("model.", "model.language_model.", 1)

    return {rename(name): tensor for name, tensor in weights.items()}


def test_original_and_newer_naming_load_the_same(encode, demo_checkpoint, copy):
    base = encode()
    original = set(load_file(demo_checkpoint / "model.safetensors"))
    assert "visual.blocks.0.attn.qkv.weight" in original
    assert "model.layers.0.mlp.up_proj.weight" in original
    for change in (_with_head, _newer_names):
        shutil.copy(demo_checkpoint / "model.safetensors", copy / "model.safetensors")
        _rewrite(copy, change)
        assert torch.equal(encode(checkpoint=str(copy)), base)
    shutil.copy(demo_checkpoint / "model.safetensors", copy / "model.safetensors")
    untied = {"tie_word_embeddings": False, "text_config.tie_word_embeddings": False}
    edit(copy / "config.json", untied)
    assert torch.equal(encode(checkpoint=str(copy)), base), "an untied head is not needed"


def test_the_hubs_flat_config_and_shards_load_the_same(encode, copy):
    base = encode()
    config = json.loads((copy / "config.json").read_text())
    text = config.pop("text_config")
    rope = text.pop("rope_parameters")
    flat = {key: text[key] for key in text if key not in ("model_type", "layer_types", "dtype")}
    flat |= config | {"torch_dtype": flat.pop("dtype", "bfloat16")}
    flat["rope_theta"] = rope["rope_theta"]
    flat["rope_scaling"] = {"type": "mrope", "mrope_section": rope["mrope_section"]}
    del flat["vision_config"]["model_type"]
    (copy / "config.json").write_text(json.dumps(flat))

    weights = load_file(copy / "model.safetensors")
    (copy / "model.safetensors").unlink()
    names = sorted(weights)
    shards = {"model-00001-of-00002.safetensors": names[:50]}
    shards["model-00002-of-00002.safetensors"] = names[50:]
    for shard, members in shards.items():
        save_file({n: weights[n] for n in members}, copy / shard, metadata={"format": "pt"})
    where = {name: shard for shard, members in shards.items() for name in members}
    index = {"metadata": {}, "weight_map": where}
    (copy / "model.safetensors.index.json").write_text(json.dumps(index))
    assert torch.equal(encode(checkpoint=str(copy)), base)

    (copy / "model-00002-of-00002.safetensors").unlink()
    with pytest.raises(VLMError, match=r"missing: model-00002-of-00002\.safetensors"):
        encode(checkpoint=str(copy))


def _without_a_layer(weights):
    return {name: tensor for name, tensor in weights.items() if ".layers.2.mlp." not in name}


def _with_a_stranger(weights):
    return weights | {"visual.blocks.9.norm1.weight": torch.ones(128)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_without_a_layer, r"missing model\.language_model\.layers\.2\.mlp\.down_proj\.weight"),
        (_with_a_stranger, r"left over .*visual\.blocks\.9\.norm1\.weight"),
    ],
)
def test_no_weight_is_ever_random(encode, copy, change, message, capfd):
    _rewrite(copy, change)
    with pytest.raises(VLMError, match=message):
        encode(checkpoint=str(copy))
    assert not capfd.readouterr().err


def test_a_damaged_file_is_named(encode, copy):
    weights = (copy / "model.safetensors").read_bytes()
    (copy / "model.safetensors").write_bytes(weights[:-1000])
    with pytest.raises(VLMError, match=r"model\.safetensors: cut off or damaged"):
        encode(checkpoint=str(copy))


EVIL = """
from pathlib import Path
Path({marker!r}).touch()
raise SystemExit("code of the checkpoint ran")
"""


@pytest.mark.parametrize(
    ("name", "entries"),
    [
        (
            "preprocessor_config.json",
            {"image_processor_type": "Own", "auto_map": {"AutoImageProcessor": "evil.Own"}},
        ),
        ("config.json", {"auto_map": {"AutoConfig": "evil.Own", "AutoModel": "evil.Own"}}),
        (
            "tokenizer_config.json",
            {"tokenizer_class": "Own", "auto_map": {"AutoTokenizer": ["evil.Own", "evil.Own"]}},
        ),
        ("processor_config.json", {"steps": [{"auto_map": {"AutoImageProcessor": "evil.Own"}}]}),
    ],
)
def test_code_of_a_checkpoint_never_runs_whatever_is_answered(
    encode, copy, tmp_path, monkeypatch, name, entries
):
    marker = tmp_path / "ran"
    (copy / "evil.py").write_text(EVIL.format(marker=str(marker)))
    edit(copy / name, entries)
    # Where transformers puts the code that it runs.
    monkeypatch.setattr("transformers.dynamic_module_utils.HF_MODULES_CACHE", str(tmp_path / "hf"))
    doors: list[Callable[[], object]] = [
        lambda: PixelSettings.read(copy, (56, 56)),
        lambda: PromptRenderer(copy, "{instruction}"),
        lambda: load_model(VLMParams(checkpoint=str(copy)), 1, torch.device("cpu")),
        lambda: encode(checkpoint=str(copy)),
    ]
    for door in doors:
        monkeypatch.setattr("sys.stdin", io.StringIO("y\n" * 100))
        with suppress(VLMError):
            door()
        assert not marker.exists(), "code of the checkpoint ran"
    with pytest.raises(
        VLMError,
        match=rf"{name}: expected .*no code of the checkpoint's own, found auto_map .*evil\.Own",
    ):
        encode(checkpoint=str(copy))


def _as_integers(weights):
    name = "model.layers.1.mlp.down_proj.weight"
    return weights | {name: (weights[name] * 100).to(torch.int8)}


def test_weights_that_are_no_floats_are_refused(encode, copy):
    _rewrite(copy, _as_integers)
    with pytest.raises(VLMError, match=r"model\.safetensors.*1 of .*layers\.1\.mlp.*of I8"):
        encode(checkpoint=str(copy))
    _rewrite(copy, lambda weights: {name: one.half() for name, one in weights.items()})
    encode(checkpoint=str(copy))
    edit(copy / "config.json", {"quantization_config": {"load_in_8bit": True}})
    with pytest.raises(VLMError, match=r"config\.json.*bfloat16.*load_in_8bit"):
        encode(checkpoint=str(copy))


def test_what_this_machine_cannot_do_is_said(extractor, encode):
    with pytest.raises(VLMError, match="flash_attention_2 needs CUDA"):
        encode(attention="flash_attention_2")
    ours = extractor()
    with pytest.raises(ConfigError, match="device: tpu0"):
        type(ours.model).load(ours.vlm, ours.spec, "tpu0")
    assert ours.model.environment["device"] == "cpu"
    assert ours.model.environment["torch"] == torch.__version__


@pytest.fixture(scope="module")
def make_adapter(demo_checkpoint):
    def make(folder, strength, targets="all-linear"):
        base = Qwen2_5_VLForConditionalGeneration.from_pretrained(demo_checkpoint)
        config = LoraConfig(r=4, lora_alpha=8, target_modules=targets)
        adapted: Any = get_peft_model(base, config)
        generator = torch.Generator().manual_seed(0)
        for name, parameter in adapted.named_parameters():
            if "lora_B" in name:
                values = torch.randn(parameter.shape, generator=generator)
                parameter.data.copy_(strength * values)
        adapted.save_pretrained(folder)
        return folder

    return make


def test_each_adapter_is_another_identity(make_adapter, vlm_params, tmp_path):
    weak, strong = (make_adapter(tmp_path / f"{by}", by) for by in (0.0, 0.1))
    every = (vlm_params(adapter=adapter) for adapter in (None, str(weak), str(strong)))
    assert len({feature_spec(vlm, "float32", (), file_digest).digest for vlm in every}) == 3


def test_an_adapter_is_what_peft_makes_of_it(extractor, make_adapter, demo_checkpoint, tmp_path):
    folder = make_adapter(tmp_path / "lora", 0.1, ["q_proj", "v_proj"])
    ours = extractor(adapter=str(folder), pooling=["last"])
    row = ours.preparer.prepare("insert the needle", {})
    base = Qwen2_5_VLForConditionalGeneration.from_pretrained(demo_checkpoint)
    adapted = PeftModel.from_pretrained(base, str(folder)).eval()
    inner: Any = adapted.base_model.model.model
    with torch.no_grad():
        expected = inner(input_ids=torch.tensor(row.token_ids)[None]).last_hidden_state[0, -1]
    torch.testing.assert_close(ours.model.encode([row])[0][0, 0], expected, atol=1e-4, rtol=1e-4)


def test_an_adapter_that_does_not_fit_is_refused(encode, make_adapter, tmp_path):
    folder = make_adapter(tmp_path / "adapter", 0.1)
    weights = folder / "adapter_model.safetensors"
    whole = load_file(weights)
    dropped = sorted(whole)[0]
    save_file({name: t for name, t in whole.items() if name != dropped}, weights)
    with pytest.raises(VLMError, match="missing base_model"):
        encode(adapter=str(folder))
    save_file(whole | {"base_model.model.model.nowhere.lora_A.weight": torch.ones(4, 4)}, weights)
    with pytest.raises(VLMError, match="left over"):
        encode(adapter=str(folder))
    save_file(whole, weights)
    edit(folder / "adapter_config.json", {"r": 8})
    with pytest.raises(VLMError, match="does not fit"):
        encode(adapter=str(folder))
    weights.unlink()
    with pytest.raises(VLMError, match=r"adapter_model\.safetensors: no such file"):
        encode(adapter=str(folder))


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("peft_type", "OWN", "peft_type: expected 'LORA', found 'OWN'"),
        ("lora_alpha", float("nan"), "cannot be merged: ValueError: NaNs detected"),
        ("target_modules", "((", "does not fit the checkpoint .*unterminated"),
        ("megatron_config", {"a": 1}, "megatron_config: expected null"),
    ],
)
def test_what_an_adapter_may_not_say(encode, make_adapter, tmp_path, key, value, told):
    folder = make_adapter(tmp_path / "adapter", 0.1)
    edit(folder / "adapter_config.json", {key: value})
    mend = r"Set vlm\.adapter to a LoRA adapter of this checkpoint"
    with pytest.raises(VLMError, match=rf"{folder}.*{told}.*{mend}"):
        encode(adapter=str(folder))


def test_a_config_of_other_weights_is_refused(encode, copy):
    config = json.loads((copy / "config.json").read_text())
    text = config["text_config"]
    for entries, told in (
        ({"hidden_act": "own"}, r"cannot be loaded as Qwen2\.5-VL: KeyError: 'own'"),
        ({"intermediate_size": 96}, r"mlp\.\w+\.weight of \[\d+, \d+\] by config\.json, found"),
        ({"num_hidden_layers": 6, "layer_types": None}, r"missing model.*layers\.4\."),
    ):
        (copy / "config.json").write_text(json.dumps(config | {"text_config": text | entries}))
        with pytest.raises(VLMError, match=rf"{copy}: .*{told}.*(Copy|download)"):
            encode(checkpoint=str(copy))
