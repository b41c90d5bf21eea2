"""The memory of a process is the machine's or its container's; devices go by name."""

import mmap
import os
from pathlib import Path

import pytest
import torch

from pipeline.base.errors import ConfigError
from pipeline.base.hardware import available_bytes, memory_bytes, resolve_device, use_bfloat16

CPU, CUDA = torch.device("cpu"), torch.device("cuda")
PAGE = mmap.PAGESIZE
GIB = 2**30


@pytest.fixture
def machine(tmp_path) -> Path:
    """`/` of a machine with 64 GiB, of which 48 can be had."""
    write(tmp_path / "proc/meminfo", f"MemTotal: {64 * 2**20} kB\nMemAvailable: {48 * 2**20} kB\n")
    return tmp_path


def write(path: Path, text: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{text}\n")


def limit(group: Path, limit: object, used: int, file_pages: int) -> None:
    """A control group of version 2."""
    write(group / "memory.max", limit)
    write(group / "memory.current", used)
    pages = f"anon {used - file_pages}\ninactive_file {file_pages - 1}\nactive_file 1"
    write(group / "memory.stat", pages)


def test_memory_is_the_machines_where_nothing_is_limited(machine):
    assert (memory_bytes(machine), available_bytes(machine)) == (64 * GIB, 48 * GIB)
    write(machine / "proc/self/cgroup", "0::/user/job")
    limit(machine / "sys/fs/cgroup/user/job", "max", GIB, 2)
    assert (memory_bytes(machine), available_bytes(machine)) == (64 * GIB, 48 * GIB)
    whole = os.sysconf("SC_PHYS_PAGES") * PAGE
    assert 0 < available_bytes() <= memory_bytes() <= whole


@pytest.mark.parametrize("limited", ["", "user", "user/job"])
def test_the_least_limit_of_the_groups_above_counts(machine, limited):
    """In a container the group's place is that of the host, of which only the top is seen."""
    groups = machine / "sys/fs/cgroup"
    write(machine / "proc/self/cgroup", "0::/user/job")
    limit(groups / limited, 8 * GIB, 5 * GIB, 2 * GIB)
    limit(groups / "another", GIB, 0, 2)
    assert (memory_bytes(machine), available_bytes(machine)) == (8 * GIB, 5 * GIB)
    limit(groups / limited, 8 * GIB, 8 * GIB, 2)
    assert available_bytes(machine) == 2
    limit(groups / limited, 8 * GIB, 9 * GIB, 2)
    assert available_bytes(machine) == 0


@pytest.mark.parametrize(
    ("amp", "device", "supported", "expected"),
    [
        ("auto", CPU, True, False),
        ("auto", CUDA, True, True),
        ("auto", CUDA, False, False),
        ("off", CUDA, True, False),
        ("bfloat16", CPU, False, True),
    ],
)
def test_when_the_forward_pass_runs_in_bfloat16(monkeypatch, amp, device, supported, expected):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: supported)
    assert use_bfloat16(amp, device) is expected


def test_a_device_that_is_not_there_is_an_error_that_says_who_knows_more() -> None:
    with pytest.raises(ConfigError, match=r"device: cuda:77: .*python -m stages\.doctor says"):
        resolve_device("cuda:77")
