"""Whether the vision-language model is here and whole, and whether it fits."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from pipeline.base.commands import command
from pipeline.base.config import Params, VLMParams
from pipeline.base.errors import VLMError
from pipeline.base.format import size
from pipeline.base.issue import Issue
from pipeline.base.memory import available_bytes
from pipeline.look.doctor import missing, note, ok
from pipeline.look.doctor.gpu import GPU, read_gpus, usable_device
from pipeline.simulation.demo_recordings import MARKER
from pipeline.vlm import checkpoint_folder

_EXAMPLE = "set vlm.checkpoint to a folder or a hub id, such as Qwen/Qwen2.5-VL-3B-Instruct"
_BESIDE = 2 * 2**30
"""Roughly what else a GPU holds while the model works: CUDA itself and a batch's activations."""


def check(params: Params) -> Iterator[Issue]:
    """`vlm.checkpoint` and `vlm.adapter`; nothing is downloaded, no weight is read."""
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
    """Where a checkpoint lies on this machine, in a folder or the hub's cache; None without."""
    if folder := checkpoint_folder.folder_here(checkpoint):
        return folder
    if not checkpoint_folder.could_be_hub_id(checkpoint):
        return None
    return checkpoint_folder.cached_checkpoint(checkpoint, revision)


def absent_checkpoint(params: Params) -> Issue:
    """What is said of a checkpoint that is not on this machine."""
    checkpoint, subject = params.vlm.checkpoint, "vlm.checkpoint"
    absent, remedy = f"{checkpoint}: not on this machine", f"hf download {checkpoint}"
    if Path(checkpoint) == params.demo.checkpoint:
        return missing(subject, absent, f"{command('demo')} (or dvc repro)")
    if not checkpoint_folder.could_be_hub_id(checkpoint):
        return missing(subject, f"{absent}, and no hub id", _EXAMPLE)
    return note(subject, f"{absent}; the first extraction downloads it", remedy)


def check_adapter(adapter: str) -> Issue:
    """`vlm.adapter`."""
    try:
        folder = local_folder(adapter, None)
        if folder is None:
            raise VLMError(f"{adapter}: not on this machine")
        checkpoint_folder.adapter_files(folder)
    except VLMError as error:
        return missing("vlm.adapter", str(error), "copy it again, or set vlm.adapter to null")
    return ok("vlm.adapter", adapter)


def check_fit(count: int, vlm: VLMParams, gpus: Sequence[GPU], available: int) -> Issue:
    """Whether the weights fit: on the smallest GPU, else into the memory that is free."""
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
