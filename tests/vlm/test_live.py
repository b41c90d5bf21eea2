"""The live model gives the frozen one's features, learns what it should, and saves it."""

import json
from copy import deepcopy
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor
from transformers import Qwen2_5_VLForConditionalGeneration

from pipeline.base.config import TuningParams
from pipeline.base.errors import VLMError
from pipeline.vlm.live import LiveVLM
from pipeline.vlm.preparation import PreparedRow

POOLING = {"pooling": ["mean", "view_mean", "last"]}
BF16_TOLERANCE = 0.06
"""Largest relative error of a slot that bfloat16 makes: as between two batches of frozen rows."""


@pytest.fixture(scope="module")
def jobs(make_frame):
    """Rows of different length and views, one without any."""
    frames = {view: make_frame(seed) for seed, view in enumerate(("View1", "View2", "View3"))}
    return [
        ("insert the needle", frames),
        ("move slowly to the left", {"View2": frames["View2"]}),
        ("hold", {}),
    ]


@pytest.fixture(scope="module")
def prepare(extractor, jobs):
    """The frozen extractor of some params, its rows and their features; made once each."""
    made: dict[str, tuple[Any, list[PreparedRow], Tensor]] = {}

    def make(*args, **changes):
        asked = repr((args, changes))
        if asked not in made:
            frozen = extractor(*args, **(POOLING | changes))
            rows = [frozen.preparer.prepare(*job) for job in jobs]
            made[asked] = frozen, rows, frozen.model.encode(rows)[0]
        return made[asked]

    return make


def _live(frozen, **tuning):
    torch.manual_seed(0)
    return LiveVLM.load(frozen.vlm, frozen.spec, TuningParams(**tuning), "cpu")


def _stir(live, strength=0.05):
    """Move what learns, as a training would: adapters begin as zero."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in _learning(live).values():
            scale = strength * parameter.std() if parameter.std() > 0 else strength
            parameter += scale * torch.randn(parameter.shape, generator=generator)


def _learning(live):
    return {name: p for name, p in live.named_parameters() if p.requires_grad}


def _gradients(live, rows):
    torch.manual_seed(3)
    features, _ = live(rows)
    weights = torch.randn(features.shape, generator=torch.Generator().manual_seed(2))
    (features * weights).sum().backward()
    found = {}
    for name, parameter in _learning(live).items():
        assert parameter.grad is not None, f"no gradient at {name}"
        found[name] = parameter.grad.clone()
    live.zero_grad()
    return found


def _relative(a, b):
    return (a - b).norm(dim=-1) / b.norm(dim=-1).clamp(min=1e-6)


@pytest.mark.parametrize("method", ["none", "lora", "full"])
def test_an_untrained_live_model_is_the_frozen_one(prepare, method):
    frozen, rows, expected = prepare(layers=[-1, 1], norms=[True, False])
    live = _live(frozen, method=method).eval()
    features, valid = live(rows)
    torch.testing.assert_close(features, expected, atol=2e-5, rtol=1e-4)
    assert torch.equal(valid, frozen.model.encode(rows)[1])
    assert features.requires_grad == (method != "none")
    assert bool(_learning(live)) == (method != "none")


@pytest.mark.parametrize("method", ["lora", "full"])
def test_bfloat16_agrees_within_its_noise(prepare, method):
    frozen, rows, expected = prepare("bfloat16", dtype="bfloat16")
    live = _live(frozen, method=method).eval()
    features, valid = live(rows)
    assert features.dtype == torch.float32
    assert _relative(features, expected.float())[valid].max() < BF16_TOLERANCE
    assert {p.dtype for p in _learning(live).values()} <= {torch.float32}
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(live(rows)[0], features)


@pytest.mark.parametrize(
    ("tuning", "towers"),
    [
        ({"method": "lora"}, {"language_model", "visual"}),
        ({"method": "full", "towers": ["language"]}, {"language_model"}),
    ],
)
def test_gradients_reach_all_that_learns_with_checkpointing_or_without(prepare, tuning, towers):
    frozen, rows, _ = prepare(layers=[2])
    found = []
    for checkpointing in (True, False):
        live = _live(frozen, **tuning, gradient_checkpointing=checkpointing)
        _stir(live)
        found.append(_gradients(live.train(), rows))
    assert {tower for name in found[0] for tower in towers if tower in name} == towers
    assert not any(name for name in found[0] if not any(tower in name for tower in towers))
    assert found[0].keys() == found[1].keys()
    for name, gradient in found[0].items():
        assert gradient.any(), f"{name} has a gradient of zeros"
        torch.testing.assert_close(gradient, found[1][name], atol=1e-5, rtol=1e-4)


def test_lora_stands_on_every_linear_layer_that_runs(prepare):
    frozen, _, _ = prepare(layers=[1])
    live = _live(frozen, lora_r=3)
    names = {name.partition(".lora_")[0] for name in _learning(live)}
    linear = {
        f"model.base_model.model.{name}"
        for name, module in Qwen2_5_VLForConditionalGeneration.from_pretrained(
            frozen.vlm.checkpoint
        ).named_modules()
        if isinstance(module, torch.nn.Linear) and name != "lm_head"
    }
    beyond = {name for name in linear if ".layers.2." in name or ".layers.3." in name}
    assert names == linear - beyond
    assert all(3 in parameter.shape for parameter in _learning(live).values())


def test_a_saved_adapter_makes_the_frozen_model_the_live_one(prepare, tmp_path):
    frozen, rows, before = prepare(layers=[2])
    live = _live(frozen, lora_r=4, lora_alpha=8)
    _stir(live)
    live.save(tmp_path / "adapter")
    assert {path.name for path in (tmp_path / "adapter").iterdir()} == {
        "adapter_config.json",
        "adapter_model.safetensors",
    }
    config = json.loads((tmp_path / "adapter" / "adapter_config.json").read_text())
    assert config["base_model_name_or_path"] == frozen.vlm.checkpoint
    assert (config["peft_type"], config["r"], config["lora_alpha"]) == ("LORA", 4, 8)

    tuned, _, after = prepare(layers=[2], adapter=str(tmp_path / "adapter"))
    assert tuned.spec.digest != frozen.spec.digest
    with torch.no_grad():
        features, valid = live.eval()(rows)
    torch.testing.assert_close(features, after, atol=5e-5, rtol=1e-4)
    assert _relative(after, before)[valid].mean() > 0.05


def test_the_same_adapter_is_the_same_file(prepare, tmp_path):
    frozen, _, _ = prepare()
    for name in ("one", "two"):
        _live(frozen).save(tmp_path / name)
    for file in ("adapter_config.json", "adapter_model.safetensors"):
        first, second = ((tmp_path / name / file).read_bytes() for name in ("one", "two"))
        assert first == second
    with pytest.raises(VLMError, match="lora begins from a checkpoint without an adapter"):
        _live(prepare(adapter=str(tmp_path / "one"))[0])


def test_full_saves_a_complete_checkpoint(prepare, demo_checkpoint, tmp_path):
    adapted = _live(prepare()[0], lora_r=4, lora_alpha=8)
    _stir(adapted)
    adapted.save(tmp_path / "adapter")
    frozen, rows, _ = prepare(layers=[1], adapter=str(tmp_path / "adapter"))
    live = _live(frozen, method="full")
    _stir(live)
    live.save(tmp_path / "tuned")
    checkpoint = str(tmp_path / "tuned")
    tuned, _, features = prepare(layers=[1], checkpoint=checkpoint)
    with torch.no_grad():
        torch.testing.assert_close(live.eval()(rows)[0], features, atol=5e-5, rtol=1e-4)
    assert tuned.spec.digest != frozen.spec.digest
    assert tuned.spec.document["tokenizer"] == frozen.spec.document["tokenizer"]
    for name in ("config.json", "preprocessor_config.json", "tokenizer.json"):
        assert (tmp_path / "tuned" / name).read_bytes() == (demo_checkpoint / name).read_bytes()

    # Layers above the last that a slot reads are the base's, with the adapter merged.
    names = load_file(demo_checkpoint / "model.safetensors").keys()
    saved = load_file(tmp_path / "tuned" / "model.safetensors")
    assert saved.keys() == names
    above = prepare(adapter=str(tmp_path / "adapter"))[0].model._model.language_model.layers[3]
    whole = prepare(checkpoint=checkpoint)[0].model._model.language_model.layers[3]
    for one, other in zip(above.parameters(), whole.parameters(), strict=True):
        torch.testing.assert_close(one, other)


def test_full_keeps_the_dtype_of_its_base(prepare, copy, tmp_path):
    model = Qwen2_5_VLForConditionalGeneration.from_pretrained(copy, dtype=torch.bfloat16)
    model.save_pretrained(copy)
    frozen, rows, _ = prepare("bfloat16", dtype="bfloat16", checkpoint=str(copy))
    live = _live(frozen, method="full")
    _stir(live)
    live.save(tmp_path / "tuned")
    saved = load_file(tmp_path / "tuned" / "model.safetensors")
    assert {tensor.dtype for tensor in saved.values()} == {torch.bfloat16}
    again = prepare("bfloat16", dtype="bfloat16", checkpoint=str(tmp_path / "tuned"))[2]
    features, valid = live.eval()(rows)
    assert _relative(features, again.float())[valid].max() < BF16_TOLERANCE


@pytest.mark.parametrize("method", ["lora", "full"])
def test_a_copy_shares_what_is_frozen(prepare, method):
    frozen, rows, _ = prepare()
    live = _live(frozen, method=method).eval()
    memo = {id(p): p for p in live.parameters() if not p.requires_grad}
    twin = deepcopy(live, memo)
    pairs = zip(live.named_parameters(), twin.named_parameters(), strict=True)
    for (name, mine), (its_name, its) in pairs:
        assert name == its_name
        assert (mine is its) == (not mine.requires_grad)
    before = live(rows)[0]
    assert torch.equal(twin(rows)[0], before)
    _stir(twin)
    assert torch.equal(live(rows)[0], before)
    assert (twin(rows)[0] - before).abs().max() > 1e-3


def test_none_saves_nothing_and_float16_does_not_learn(prepare, tmp_path):
    frozen, _, _ = prepare()
    _live(frozen, method="none").save(tmp_path / "nothing")
    assert not (tmp_path / "nothing").exists()
    half = prepare("float16", dtype="float16")[0]
    with pytest.raises(VLMError, match="float16 is too narrow for gradients"):
        _live(half)
