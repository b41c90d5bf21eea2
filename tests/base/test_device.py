"""Devices by name, and the precision that `amp` asks for on each."""

import pytest
import torch

from pipeline.base.errors import ConfigError
from pipeline.base.machine import resolve_device, use_bfloat16

CPU, CUDA = torch.device("cpu"), torch.device("cuda")


@pytest.mark.parametrize(
    ("amp", "device", "supported", "expected"),
    [
        ("auto", CPU, True, False),
        ("auto", CUDA, True, True),
        ("auto", CUDA, False, False),
        ("off", CUDA, True, False),
        ("bfloat16", CPU, False, True),
        ("bfloat16", CUDA, True, True),
    ],
)
def test_when_the_forward_pass_runs_in_bfloat16(
    monkeypatch: pytest.MonkeyPatch, amp, device: torch.device, supported: bool, expected: bool
) -> None:
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: supported)
    assert use_bfloat16(amp, device) is expected


def test_a_device_that_is_not_there_is_an_error_that_says_who_knows_more() -> None:
    with pytest.raises(ConfigError, match=r"device: cuda:77: .*python -m stages\.doctor says"):
        resolve_device("cuda:77")
