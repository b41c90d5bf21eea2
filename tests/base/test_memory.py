"""The memory that counts is the machine's, or what a container leaves of it."""

import mmap
import os
from pathlib import Path

import pytest

from pipeline.base.machine import available_bytes, memory_bytes

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
