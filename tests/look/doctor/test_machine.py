"""The machine: its GPUs and what they can do, and the checkpoint that shall fit into it."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from pipeline.base.config import Params
from pipeline.look.doctor.machine import (
    FLASH,
    GPU,
    check_adapter,
    check_attention,
    check_checkpoint,
    check_fit,
    check_gpu,
    check_gpus,
    read_gpus,
)
from pipeline.simulation.demo_recordings import MARKER

GIB = 2**30
Make = Callable[..., Params]


@pytest.fixture
def params(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Make:
    """`params(checkpoint, key=value…)` with an empty cache of the hub."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)

    def make(checkpoint: str | Path, **vlm: object) -> Params:
        document = {
            "data": {"sources": [{"name": "a", "path": "."}]},
            "vlm": {"checkpoint": str(checkpoint), "dtype": "float32", **vlm},
            "extract": {"device": "cpu"},
        }
        return Params.model_validate(document)

    return make


def test_a_whole_folder(params: Make, demo_checkpoint: Path) -> None:
    here, fits = check_checkpoint(params(demo_checkpoint))
    assert (here.severity, fits.severity) == ("ok", "ok")
    assert "whole, 2,519,424 parameters" in here.message
    assert fits.message.startswith("9.6 MiB in float32, memory has")


def test_the_demos_random_weights_are_nothing_to_learn_from(params, demo_checkpoint, tmp_path):
    """Wherever the folder that stages.demo marks lies."""
    mine = shutil.copytree(demo_checkpoint, tmp_path / "mine")
    (mine / MARKER).write_text('{"seed": 0}')
    here, fits = check_checkpoint(params(mine))
    assert (here.severity, fits.severity) == ("note", "ok")
    assert "whole, " in here.message and "random weights" in here.message
    assert "Qwen/Qwen2.5-VL-3B-Instruct" in here.remedy and "docs/real-model.md" in here.remedy


def test_a_folder_with_a_hole_or_a_file_that_is_cut_off(params, demo_checkpoint, tmp_path):
    broken = shutil.copytree(demo_checkpoint, tmp_path / "broken")
    weights = next(broken.glob("*.safetensors"))
    whole = weights.read_bytes()
    for kept in (whole[:-1], whole[:5], b"\x08" + bytes(7) + b"garbage!"):
        weights.write_bytes(kept)
        (issue,) = check_checkpoint(params(broken))
        assert (issue.severity, issue.remedy) == ("error", "copy it again")
        assert str(weights) in issue.message
    weights.unlink()
    (issue,) = check_checkpoint(params(broken))
    assert issue.severity == "error" and str(broken) in issue.message


def test_what_is_not_here(params: Make, tmp_path: Path) -> None:
    (folder,) = check_checkpoint(params("/no/such/folder"))
    assert folder.severity == "error" and "no hub id" in folder.message
    (fetched,) = check_checkpoint(params("Qwen/Qwen2.5-VL-3B-Instruct"))
    assert fetched.severity == "note"
    assert fetched.remedy == "hf download Qwen/Qwen2.5-VL-3B-Instruct"
    given = params(tmp_path / "demo_vlm")
    demo = given.demo.model_copy(update={"checkpoint": tmp_path / "demo_vlm"})
    (issue,) = check_checkpoint(given.model_copy(update={"demo": demo}))
    assert issue.severity == "error" and "stages.demo" in issue.remedy


def test_an_adapter(tmp_path: Path) -> None:
    assert check_adapter("/no/such/adapter").severity == "error"
    (tmp_path / "adapter_config.json").write_text('{"peft_type": "LORA", "r": 2}')
    half = check_adapter(str(tmp_path))
    assert half.severity == "error" and "adapter_model.safetensors" in half.message
    weights = tmp_path / "adapter_model.safetensors"
    weights.write_bytes(b"")
    damaged = check_adapter(str(tmp_path))
    assert damaged.severity == "error" and "cut off or damaged" in damaged.message
    save_file({"lora_A.weight": torch.zeros(2, 2)}, weights)
    assert check_adapter(str(tmp_path)).severity == "ok"


@pytest.mark.parametrize(
    ("dtype", "gpus", "available", "level"),
    [
        ("bfloat16", [24], 8, "ok"),
        ("float32", [24], 64, "note"),
        ("bfloat16", [80, 8], 64, "note"),
        ("bfloat16", [], 16, "ok"),
        ("float32", [], 16, "note"),
    ],
)
def test_seven_billion_parameters_fit_or_not(params, dtype, gpus, available, level):
    found = [GPU(f"GPU {gib}", gib * GIB, True) for gib in gpus]
    issue = check_fit(7_000_000_000, params("a/b", dtype=dtype).vlm, found, available * GIB)
    assert issue.severity == level


H100 = GPU("NVIDIA H100", 80 * 2**30, True)


def with_sections(**sections: object) -> Params:
    document = {
        "data": {"sources": [{"name": "a", "path": "."}]},
        "vlm": {"checkpoint": "a/b"},
        "train_head": {"device": "cpu"},
        **sections,
    }
    return Params.model_validate(document)


@pytest.mark.parametrize(("driver", "said"), [(False, "no GPU driver"), (True, "torch sees none")])
def test_a_gpu_that_torch_does_not_see(driver: bool, said: str) -> None:
    (issue,) = check_gpus((), driver, "bfloat16")
    assert issue.severity == "note", "everything runs on the CPU too"
    assert said in issue.message
    assert ("--gpus all" in issue.remedy) == driver


def test_what_the_params_ask_for_by_name_is_needed() -> None:
    lacking = [
        issue
        for issue in check_gpu(with_sections(extract={"device": "cuda:77"}))
        if issue.severity == "error"
    ]
    assert [issue.kind for issue in lacking] == ["extract.device"], "it is said once"
    assert "extract.device=auto" in lacking[0].remedy


def test_gpus_that_are_seen() -> None:
    old = GPU("Tesla T4", 15 * 2**30, False)
    build, first, second = check_gpus((H100, old), True, "bfloat16")
    assert build.message.startswith(f"torch {torch.__version__}, built for ")
    assert (first.severity, first.message) == ("ok", "NVIDIA H100, 80.0 GiB")
    assert second.severity == "note"
    assert "vlm.dtype to float16" in second.remedy
    assert [one.severity for one in check_gpus((H100, old), True, "float16")] == 3 * ["ok"]
    assert all(one.memory > 0 for one in read_gpus())


@pytest.mark.parametrize(
    ("installed", "device", "asked", "severity"),
    [
        (True, "cuda", "auto", "ok"),
        (True, "cuda", "flash_attention_2", "ok"),
        (False, "cuda", "auto", "note"),
        (False, "cuda", "flash_attention_2", "error"),
        (True, "cpu", "flash_attention_2", "error"),
    ],
)
def test_flash_attention_is_needed_only_where_it_is_asked_for(
    monkeypatch, installed, device, asked, severity
):
    monkeypatch.setattr("pipeline.vlm.loading.is_flash_attn_2_available", lambda: installed)
    vlm = with_sections(vlm={"checkpoint": "a/b", "attention": asked}).vlm
    issue = check_attention(vlm, torch.device(device))
    assert issue.severity == severity
    assert (FLASH in issue.remedy) == (severity != "ok")
