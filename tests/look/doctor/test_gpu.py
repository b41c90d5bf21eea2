"""What torch sees of a GPU, why it sees none, and which attention the model would take."""

import pytest
import torch

from pipeline.base.config import Params
from pipeline.look.doctor.machine import (
    FLASH,
    GPU,
    check_attention,
    check_gpu,
    check_gpus,
    read_gpus,
)

H100 = GPU("NVIDIA H100", 80 * 2**30, True)


def params(**sections: object) -> Params:
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
        for issue in check_gpu(params(extract={"device": "cuda:77"}))
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
    vlm = params(vlm={"checkpoint": "a/b", "attention": asked}).vlm
    issue = check_attention(vlm, torch.device(device))
    assert issue.severity == severity
    assert (FLASH in issue.remedy) == (severity != "ok")
