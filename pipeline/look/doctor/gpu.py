"""Whether torch can use the GPU that is there, and which attention the model would take."""

import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from pipeline.base.config import Params, VLMParams
from pipeline.base.device import resolve_device
from pipeline.base.errors import ConfigError
from pipeline.base.format import size
from pipeline.base.issue import Issue
from pipeline.base.memory import memory_bytes
from pipeline.look.doctor import missing, note, ok
from pipeline.vlm.loading import attention_backend

FLASH = "pip install flash-attn --no-build-isolation"
_SEE_GPU = (
    "look at CUDA_VISIBLE_DEVICES and nvidia-smi (in a container, start it with --gpus all), or "
    "install torch for the driver's CUDA version as pytorch.org/get-started says"
)
_DRIVERS = ("/proc/driver/nvidia/version", "/dev/kfd")
"""There where an NVIDIA or an AMD driver is."""


@dataclass(frozen=True)
class GPU:
    """A device that torch can use."""

    name: str
    memory: int
    """Bytes."""
    bfloat16: bool
    """Whether it computes in bfloat16 itself."""


def check(params: Params) -> Iterator[Issue]:
    """The machine, its GPU and the attention backend under these params."""
    yield ok("machine", f"{len(os.sched_getaffinity(0))} cores, {size(memory_bytes())} of memory")
    driver = shutil.which("nvidia-smi") is not None or any(Path(path).exists() for path in _DRIVERS)
    yield from check_gpus(read_gpus(), driver, params.vlm.dtype)
    for section in ("extract", "train_head", "evaluate"):
        name = getattr(params, section).device
        if usable_device(name) is None:
            key = f"{section}.device"
            text = f"{name}: torch cannot use it here, see GPU"
            yield missing(key, text, f"mend that, or set {key}=auto")
    device = usable_device(params.extract.device)
    if device is not None:
        yield check_attention(params.vlm, device)


def usable_device(name: str) -> torch.device | None:
    """The device of a param; None where torch cannot use it here, which `check` says."""
    try:
        return resolve_device(name)
    except ConfigError:
        return None


def read_gpus() -> tuple[GPU, ...]:
    """What torch sees."""
    # A count of 0 without a warning where the driver does not answer.
    if not (torch.cuda.device_count() and torch.cuda.is_available()):
        return ()
    seen = [torch.cuda.get_device_properties(at) for at in range(torch.cuda.device_count())]
    amd = torch.version.hip is not None
    return tuple(GPU(device.name, device.total_memory, amd or device.major >= 8) for device in seen)


def check_gpus(gpus: Sequence[GPU], driver: bool, dtype: str) -> Iterator[Issue]:
    """What torch sees and can do; where it sees nothing, why."""
    built_for = {"CUDA": torch.version.cuda, "ROCm": torch.version.hip}
    made_for = [f"{name} {version}" for name, version in built_for.items() if version]
    build = f"torch {torch.__version__}, built for {', '.join(made_for) or 'the CPU only'}"
    if gpus:
        yield ok("build", build)
    elif driver:
        text = f"{build}; this machine has a GPU driver, but torch sees none"
        yield note("GPU", text, _SEE_GPU)
    else:
        text = f"{build}; this machine has no GPU driver: the CPU does for the demo, not for more"
        yield note("GPU", text)
    for index, gpu in enumerate(gpus):
        text = f"{gpu.name}, {size(gpu.memory)}"
        if dtype != "bfloat16" or gpu.bfloat16:
            yield ok(f"cuda:{index}", text)
        else:
            text += "; it only emulates bfloat16, which vlm.dtype asks for"
            yield note(f"cuda:{index}", text, "set vlm.dtype to float16 or float32")


def check_attention(vlm: VLMParams, device: torch.device) -> Issue:
    """What `vlm.attention` comes to."""
    best = attention_backend(vlm.model_copy(update={"attention": "auto"}), device)
    if vlm.attention == "flash_attention_2" != best:
        text = f"{vlm.attention} needs CUDA, half precision and the package flash-attn, found "
        text += f"{device} with vlm.dtype {vlm.dtype}"
        return missing("attention", text, f"set vlm.attention to auto, or {FLASH}")
    taken = attention_backend(vlm, device)
    text = f"vlm.attention: {vlm.attention} takes {taken} on {device}"
    if device.type == "cuda" and vlm.dtype != "float32" and best == "sdpa":
        return note("attention", f"{text}; flash-attention is optional", FLASH)
    return ok("attention", text)
