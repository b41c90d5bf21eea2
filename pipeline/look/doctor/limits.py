"""What the machine and its kernel allow: cores, memory, open files, shared memory."""

import os
import resource
import shutil
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.config import Params
from pipeline.base.format import size
from pipeline.base.memory import memory_bytes
from pipeline.look.doctor.findings import Finding, note, ok

_CGROUP = Path("/sys/fs/cgroup")
_LEAST_FILES = 1024
_LEAST_SHARED = 2**30


@dataclass(frozen=True)
class Limits:
    """Of this process on this machine."""

    cores: float
    """That it may use."""
    memory: int
    """Bytes that it may use."""
    open_files: int
    shared: int | None
    """Bytes of /dev/shm; None without one."""


def check_limits_here(params: Params) -> list[Finding]:
    """The limits of this machine; params are not looked at."""
    return check_limits(read_limits())


def check_limits(limits: Limits) -> list[Finding]:
    """What is small."""
    findings = [ok("CPU", f"{limits.cores:g} cores"), ok("memory", size(limits.memory))]
    if limits.open_files < _LEAST_FILES:
        said = f"{limits.open_files}; workers and decoders may need more"
        findings.append(note("open files", said, "ulimit -n 4096"))
    else:
        findings.append(ok("open files", str(limits.open_files)))
    if limits.shared is not None and limits.shared < _LEAST_SHARED:
        said = f"{size(limits.shared)}; a torch DataLoader with workers passes batches through it"
        findings.append(note("/dev/shm", said, "in a container, start it with --shm-size=8g"))
    elif limits.shared is not None:
        findings.append(ok("/dev/shm", size(limits.shared)))
    return findings


def read_limits() -> Limits:
    """The facts, containers' limits included."""
    shared = Path("/dev/shm")
    return Limits(
        cores=_cores(),
        memory=memory_bytes(),
        open_files=resource.getrlimit(resource.RLIMIT_NOFILE)[0],
        shared=shutil.disk_usage(shared).total if shared.is_dir() else None,
    )


def _cores() -> float:
    allowed = float(len(os.sched_getaffinity(0)))
    quota, _, period = _read(_CGROUP / "cpu.max").partition(" ")
    return min(allowed, int(quota) / int(period)) if quota.isdigit() else allowed


def _read(path: Path) -> str:
    """A limit of a control group, where there is one."""
    return path.read_text(encoding="ascii").strip() if path.is_file() else ""
