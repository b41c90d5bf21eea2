"""Whether torch can use the GPU, and whether the vision-language model is here, whole and fits."""

import math
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from pipeline.base.commands import command
from pipeline.base.config import Params, VLMParams
from pipeline.base.errors import ConfigError, Issue, VLMError
from pipeline.base.hub import could_be_hub_id
from pipeline.base.machine import available_bytes, memory_bytes, resolve_device
from pipeline.base.text import size
from pipeline.look.doctor import missing, note, ok
from pipeline.simulation.demo_recordings import MARKER
from pipeline.vlm import checkpoint_folder
from pipeline.vlm.loading import attention_backend

FLASH = "pip install flash-attn --no-build-isolation"
_SEE_GPU = (
    "look at CUDA_VISIBLE_DEVICES and nvidia-smi (in a container, start it with --gpus all), or "
    "install torch for the driver's CUDA version as pytorch.org/get-started says"
)
_DRIVERS = ("/proc/driver/nvidia/version", "/dev/kfd")
"""Files of an NVIDIA and of an AMD driver."""
_EXAMPLE = "set vlm.checkpoint to a folder or a hub id, such as Qwen/Qwen2.5-VL-3B-Instruct"
_BESIDE = 2 * 2**30
"""Bytes that a GPU needs beside the weights, roughly: for CUDA and a batch's activations."""


@dataclass(frozen=True)
class GPU:
    """A device that torch can use."""

    name: str
    memory: int
    """Bytes."""
    bfloat16: bool
    """Whether it computes in bfloat16 itself."""


def check_gpu(params: Params) -> Iterator[Issue]:
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
    """The device of a param; None where torch cannot use it here."""
    try:
        return resolve_device(name)
    except ConfigError:
        return None


def read_gpus() -> tuple[GPU, ...]:
    """The GPUs that torch sees."""
    # If the driver does not answer, the count is 0, without a warning.
    if not (torch.cuda.device_count() and torch.cuda.is_available()):
        return ()
    seen = [torch.cuda.get_device_properties(at) for at in range(torch.cuda.device_count())]
    amd = torch.version.hip is not None
    return tuple(GPU(device.name, device.total_memory, amd or device.major >= 8) for device in seen)


def check_gpus(gpus: Sequence[GPU], driver: bool, dtype: str) -> Iterator[Issue]:
    """Torch's build and the GPUs it sees; if it sees none, why."""
    built_for = {"CUDA": torch.version.cuda, "ROCm": torch.version.hip}
    made_for = [f"{name} {version}" for name, version in built_for.items() if version]
    build = f"torch {torch.__version__}, built for {', '.join(made_for) or 'the CPU only'}"
    if gpus:
        yield ok("build", build)
    elif driver:
        yield note("GPU", f"{build}; torch sees none, though there is a GPU driver", _SEE_GPU)
    else:
        yield note("GPU", f"{build}; no GPU driver here: the CPU does for the demo, not for more")
    for index, gpu in enumerate(gpus):
        text = f"{gpu.name}, {size(gpu.memory)}"
        if dtype != "bfloat16" or gpu.bfloat16:
            yield ok(f"cuda:{index}", text)
        else:
            text += "; it only emulates bfloat16, which vlm.dtype asks for"
            yield note(f"cuda:{index}", text, "set vlm.dtype to float16 or float32")


def check_attention(vlm: VLMParams, device: torch.device) -> Issue:
    """The attention backend that `vlm.attention` gives."""
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


def check_checkpoint(params: Params) -> Iterator[Issue]:
    """Check `vlm.checkpoint` and `vlm.adapter`; nothing is downloaded, no weight is read."""
    vlm = params.vlm
    folder = local_folder(vlm.checkpoint, vlm.revision)
    if folder is None:
        yield absent_checkpoint(params)
        return
    try:
        files = checkpoint_folder.weight_files(folder)
        checkpoint_folder.tokenizer_files(folder)
        shapes = checkpoint_folder.tensor_shapes(files)
    except VLMError as error:
        own = checkpoint_folder.folder_here(vlm.checkpoint)
        remedy = "copy it again" if own else f"hf download --force-download {vlm.checkpoint}"
        yield missing("vlm.checkpoint", str(error), remedy)
        return
    count = sum(map(math.prod, shapes.values()))
    here = f"{folder}, whole, {count:,} parameters"
    if (folder / MARKER).exists():
        here += "; the demo's random weights: to look at the machinery, not to learn from"
        yield note("vlm.checkpoint", here, f"{_EXAMPLE}; docs/real-model.md")
    else:
        yield ok("vlm.checkpoint", here)
    if vlm.adapter is not None:
        yield check_adapter(vlm.adapter)
    device = usable_device(params.extract.device)
    gpus = read_gpus() if device is not None and device.type == "cuda" else ()
    yield check_fit(count, vlm, gpus, available_bytes())


def local_folder(checkpoint: str, revision: str | None) -> Path | None:
    """The folder of a checkpoint on this machine, or in its cache of the hub; None without."""
    if folder := checkpoint_folder.folder_here(checkpoint):
        return folder
    if not could_be_hub_id(checkpoint):
        return None
    return checkpoint_folder.cached_checkpoint(checkpoint, revision)


def absent_checkpoint(params: Params) -> Issue:
    """The issue of a checkpoint that is not on this machine."""
    checkpoint, subject = params.vlm.checkpoint, "vlm.checkpoint"
    absent, remedy = f"{checkpoint}: not on this machine", f"hf download {checkpoint}"
    if Path(checkpoint) == params.demo.checkpoint:
        return missing(subject, absent, f"{command('demo')} (or dvc repro)")
    if not could_be_hub_id(checkpoint):
        return missing(subject, f"{absent}, and no hub id", _EXAMPLE)
    return note(subject, f"{absent}; the first extraction downloads it", remedy)


def check_adapter(adapter: str) -> Issue:
    """Check `vlm.adapter`."""
    try:
        folder = local_folder(adapter, None)
        if folder is None:
            raise VLMError(f"{adapter}: not on this machine")
        checkpoint_folder.adapter_files(folder)
    except VLMError as error:
        return missing("vlm.adapter", str(error), "copy it again, or set vlm.adapter to null")
    return ok("vlm.adapter", adapter)


def check_fit(count: int, vlm: VLMParams, gpus: Sequence[GPU], available: int) -> Issue:
    """Whether the weights fit: on the smallest GPU, else into the free memory."""
    weights = count * getattr(torch, vlm.dtype).itemsize
    where, room, needed = "memory", available, weights
    if gpus:
        smallest = min(gpus, key=lambda gpu: gpu.memory)
        where, room, needed = smallest.name, smallest.memory, weights + _BESIDE
    text = f"{size(weights)} in {vlm.dtype}, {where} has {size(room)}"
    if needed <= room:
        return ok("it fits", text)
    half = "set vlm.dtype to bfloat16, or " if vlm.dtype == "float32" else ""
    return note("it may not fit", text, f"{half}take a smaller checkpoint, or a larger machine")
