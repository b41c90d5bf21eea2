"""GPUs: torch's build against the machine's driver, in every combination that people have."""

from dataclasses import replace

import pytest

from pipeline.base.config import Params
from pipeline.look.doctor.attention import check_attention
from pipeline.look.doctor.gpu import (
    GPU,
    Accelerator,
    check_accelerator,
    check_gpu,
    parse_nvidia_smi,
    read_accelerator,
)

BARE = Accelerator(
    torch="2.13.0+cpu",
    cuda=None,
    hip=None,
    gpus=(),
    driver=None,
    driver_cuda=None,
    amd=False,
    hidden=False,
)
NVIDIA = replace(BARE, driver="570.86", driver_cuda=12.8)
CUDA = replace(NVIDIA, torch="2.13.0+cu126", cuda="12.6")
H100 = GPU("NVIDIA H100", 80 * 2**30, True)
SMI = """
| NVIDIA-SMI 570.86.15              Driver Version: 570.86.15      CUDA Version: 12.8     |
|-----------------------------------------+------------------------+----------------------+
| GPU  Name                 Persistence-M | Bus-Id          Disp.A | Volatile Uncorr. ECC |
"""


@pytest.mark.parametrize(
    ("here", "said", "remedy"),
    [
        (BARE, "no GPU driver", ""),
        (NVIDIA, "built for the CPU only, but this machine has an NVIDIA driver 570.86", "cu128"),
        (replace(NVIDIA, driver_cuda=13.1), "built for the CPU only", "cu130"),
        (replace(NVIDIA, driver_cuda=12.2), "built for the CPU only", "cu126"),
        (replace(NVIDIA, driver="", driver_cuda=None), "an NVIDIA driver", "cu126"),
        (replace(NVIDIA, driver_cuda=11.4), "CUDA 11.4 at most", "update the driver"),
        (replace(CUDA, cuda="13.0"), "newer than the CUDA 12.8", "cu128"),
        (replace(CUDA, hidden=True), "hides every GPU", "unset CUDA_VISIBLE_DEVICES"),
        (CUDA, "no GPU answers", "--gpus all"),
        (replace(BARE, amd=True), "an AMD GPU that it does not see", "ROCm"),
    ],
)
def test_a_gpu_that_torch_does_not_see(here: Accelerator, said: str, remedy: str) -> None:
    (finding,) = check_accelerator(here, "bfloat16")
    assert finding.level == "note", "everything runs on the CPU too"
    assert said in finding.found
    assert remedy in finding.remedy


def test_what_the_params_ask_for_by_name_is_needed() -> None:
    document = {
        "data": {"sources": [{"name": "a", "path": "."}]},
        "vlm": {"checkpoint": "a/b"},
        "extract": {"device": "cuda:77"},
        "train_head": {"device": "cpu"},
    }
    params = Params.model_validate(document)
    lacking = [finding for finding in check_gpu(params) if finding.level == "missing"]
    assert [finding.subject for finding in lacking] == ["extract.device"]
    assert "extract.device=auto" in lacking[0].remedy
    (attention,) = check_attention(params)
    assert attention.level == "note", "it is said once"


def test_gpus_that_are_seen() -> None:
    old = GPU("Tesla T4", 15 * 2**30, False)
    here = replace(CUDA, gpus=(H100, old))
    build, first, second = check_accelerator(here, "bfloat16")
    assert build.found == "torch 2.13.0+cu126, built for CUDA 12.6"
    assert (first.level, first.found) == ("ok", "NVIDIA H100, 80.0 GiB")
    assert second.level == "note"
    assert "vlm.dtype to float16" in second.remedy
    assert check_accelerator(here, "float16")[2].level == "ok"


def test_nvidia_smi_is_read() -> None:
    assert parse_nvidia_smi(SMI) == ("570.86.15", 12.8)
    assert parse_nvidia_smi("CUDA Version: N/A") == ("", None)
    assert parse_nvidia_smi("") == ("", None)


def test_the_facts_of_this_machine_can_be_read() -> None:
    here = read_accelerator()
    assert here.torch[0].isdigit()
    assert all(gpu.memory > 0 for gpu in here.gpus)
    assert check_accelerator(here, "float32")
