"""Whether torch can use the GPU that is there, and which install would."""

import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import torch

from pipeline.base.config import Params
from pipeline.base.device import resolve_device
from pipeline.base.errors import ConfigError
from pipeline.base.format import size
from pipeline.look.doctor.findings import Finding, missing, note, ok

_WHEELS = ((13.0, "cu130"), (12.8, "cu128"), (12.0, "cu126"))
"""The newest CUDA build of torch that a driver of at least this CUDA version runs."""


@dataclass(frozen=True)
class GPU:
    """A device that torch can use."""

    name: str
    memory: int
    """Bytes."""
    bfloat16: bool
    """Whether it computes in bfloat16 itself."""


@dataclass(frozen=True)
class Accelerator:
    """What this build of torch is made for, what it sees, and what the machine has."""

    torch: str
    """Version."""
    cuda: str | None
    """CUDA version that torch was built with; None for a build without."""
    hip: str | None
    """ROCm version that torch was built with."""
    gpus: tuple[GPU, ...]
    driver: str | None
    """Version of the NVIDIA driver; "" where it is there but does not answer."""
    driver_cuda: float | None
    """Newest CUDA version that the driver runs."""
    amd: bool
    """Whether there is an AMD GPU with its driver."""
    hidden: bool
    """Whether CUDA_VISIBLE_DEVICES hides every GPU."""

    @property
    def build(self) -> str:
        """In words."""
        made_for = f"CUDA {self.cuda}" if self.cuda else f"ROCm {self.hip}" if self.hip else ""
        return f"torch {self.torch}, built for {made_for or 'the CPU only'}"


def check_gpu(params: Params) -> list[Finding]:
    """The GPU of this machine under these params."""
    asked = {
        "extract.device": params.extract.device,
        "train_head.device": params.train_head.device,
        "evaluate.device": params.evaluate.device,
    }
    absent = [
        missing(key, f"{name}: torch cannot use it here, see GPU", f"mend that, or set {key}=auto")
        for key, name in asked.items()
        if usable_device(name) is None
    ]
    return [*check_accelerator(read_accelerator(), params.vlm.dtype), *absent]


def usable_device(name: str) -> torch.device | None:
    """The device of a param; None where torch cannot use it here, which `check_gpu` says."""
    try:
        return resolve_device(name)
    except ConfigError:
        return None


def check_accelerator(here: Accelerator, dtype: str) -> list[Finding]:
    """Whether torch sees the GPU, why not, and what it can do."""
    if not here.gpus:
        return [_unseen(here)]
    findings = [ok("build", here.build)]
    for index, gpu in enumerate(here.gpus):
        said = f"{gpu.name}, {size(gpu.memory)}"
        if dtype != "bfloat16" or gpu.bfloat16:
            findings.append(ok(f"cuda:{index}", said))
        else:
            said += "; it only emulates bfloat16, which vlm.dtype asks for"
            findings.append(note(f"cuda:{index}", said, "set vlm.dtype to float16 or float32"))
    return findings


def read_accelerator() -> Accelerator:
    """The facts, none of which raises."""
    gpus: list[GPU] = []
    # A count of 0 without a warning where the driver does not answer.
    if torch.cuda.device_count() and torch.cuda.is_available():
        for index in range(torch.cuda.device_count()):
            told = torch.cuda.get_device_properties(index)
            native = torch.version.hip is not None or told.major >= 8
            gpus.append(GPU(told.name, told.total_memory, native))
    driver, cuda = _nvidia_driver()
    return Accelerator(
        torch=torch.__version__,
        cuda=torch.version.cuda,
        hip=torch.version.hip,
        gpus=tuple(gpus),
        driver=driver,
        driver_cuda=cuda,
        amd=Path("/dev/kfd").exists(),
        hidden=os.environ.get("CUDA_VISIBLE_DEVICES", "all").strip() in ("", "-1"),
    )


def _unseen(here: Accelerator) -> Finding:
    """Why there is no GPU to use."""
    if here.driver is None and not here.amd:
        said = f"{here.build}; this machine has no GPU driver, so everything runs on the CPU: "
        return note("GPU", f"{said}well enough for the demo, not for a 3B or 7B checkpoint")
    if here.hidden:
        return note("GPU", "CUDA_VISIBLE_DEVICES hides every GPU", "unset CUDA_VISIBLE_DEVICES")
    if here.amd and here.driver is None:
        said = f"{here.build}, but this machine has an AMD GPU that it does not see"
        return note("GPU", said, "install torch's ROCm build, see pytorch.org/get-started")
    if here.driver_cuda is not None and here.driver_cuda < 12:
        said = f"the NVIDIA driver {here.driver} runs CUDA {here.driver_cuda:g} at most"
        return note("GPU", said, "update the driver to 525 or newer, then run this again")
    driver = f"an NVIDIA driver{f' {here.driver}' if here.driver else ''}"
    if here.cuda is None:
        said = f"{here.build}, but this machine has {driver}"
        return note("GPU", said, pip_line(here.driver_cuda))
    if here.driver_cuda is not None and float(here.cuda) > here.driver_cuda:
        said = f"{here.build}, newer than the CUDA {here.driver_cuda:g} that {driver} runs"
        return note("GPU", said, pip_line(here.driver_cuda))
    said = f"{here.build}; there is {driver}, but no GPU answers"
    return note("GPU", said, "look at nvidia-smi; in a container, start it with --gpus all")


def pip_line(driver_cuda: float | None) -> str:
    """How to install a torch whose CUDA a driver of this CUDA version runs; None is not known."""
    wheel = next((name for least, name in _WHEELS if (driver_cuda or 12.6) >= least), "cu126")
    return (
        f"pip install --force-reinstall torch, from the index that pytorch.org/get-started "
        f"names for {wheel}"
    )


def _nvidia_driver() -> tuple[str | None, float | None]:
    """The driver's version and the newest CUDA version that it runs."""
    there = Path("/proc/driver/nvidia/version").exists()
    if shutil.which("nvidia-smi") is None:
        return ("", None) if there else (None, None)
    try:
        said = subprocess.run(
            ["nvidia-smi"], capture_output=True, text=True, timeout=8, check=True
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return "", None
    return parse_nvidia_smi(said)


def parse_nvidia_smi(said: str) -> tuple[str, float | None]:
    """Driver and CUDA version from the head of nvidia-smi's table."""
    words = said.replace(":", " ").split()
    after = {"".join(words[at : at + 2]): words[at + 2] for at in range(len(words) - 2)}
    cuda = after.get("CUDAVersion", "")
    known = cuda.replace(".", "", 1).isdigit()
    return after.get("DriverVersion", ""), float(cuda) if known else None
