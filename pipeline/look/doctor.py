"""What this machine has, lacks and could have for the pipeline, and what to install or set.

Each group of checks imports what it needs itself: a broken or missing package is an issue, too.
"""

import math
import os
import sys
import textwrap
import tomllib
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from packaging.requirements import Requirement

from pipeline.base.config import Params
from pipeline.base.errors import ConfigError, Issue, PipelineError, RecordingError, VLMError
from pipeline.base.hardware import available_bytes, memory_bytes, resolve_device
from pipeline.base.hub import could_be_hub_id
from pipeline.base.printed_commands import command
from pipeline.base.text import size

if TYPE_CHECKING:
    from pipeline.data import Recording

WIDTH = 100
_INDENT = 30
_SHOWN = ("python", "torch", "transformers", "peft", "zarr", "numpy", "av", "dvc")
_SEE_GPU = (
    "with a GPU, look at nvidia-smi (in a container, start it with --gpus all) and install torch "
    "for the driver's CUDA version as pytorch.org/get-started says"
)
_EXAMPLE = "set vlm.checkpoint to a folder or a hub id, such as Qwen/Qwen2.5-VL-3B-Instruct"
_BESIDE = 2 * 2**30
"""Bytes that a GPU needs beside the weights, roughly: for CUDA and a batch's activations."""
_EPISODES = 4
"""The most episodes that are read of each source."""


def examine(params: Params) -> Generator[tuple[str, list[Issue]]]:
    """Each group's title and issues, one after the other; a check that fails is an issue too."""
    for title, check in GROUPS.items():
        try:
            issues = list(check(params))
        except (ImportError, OSError, PipelineError) as error:
            text = f"cannot be looked at: {error}"
            issues = [missing(title.lower(), text, "install or mend that, and run this again")]
        yield title, issues


def ok(subject: str, message: str) -> Issue:
    """An issue that says that the subject is as it should be."""
    return Issue(severity="ok", kind=subject, message=message)


def note(subject: str, message: str, remedy: str = "") -> Issue:
    """An issue about what works but could be better, or what will be needed later."""
    return Issue(severity="note", kind=subject, message=message, remedy=remedy)


def missing(subject: str, message: str, remedy: str) -> Issue:
    """An issue about what a stage of the default pipeline needs to run with these params."""
    return Issue(severity="error", kind=subject, message=message, remedy=remedy)


def describe(title: str, issues: Sequence[Issue]) -> list[str]:
    """A group of issues as lines of at most `WIDTH` columns."""
    lines = [title]
    for issue in issues:
        severity = "missing" if issue.severity == "error" else issue.severity
        head = f"  {severity:<8} {issue.kind:<18} ".ljust(_INDENT)
        for begin, text in ((head, issue.message), (f"{'-> ':>{_INDENT}}", issue.remedy)):
            # Users copy paths and options, so these are never broken.
            wrapper = textwrap.TextWrapper(
                WIDTH, begin, " " * len(begin), break_long_words=False, break_on_hyphens=False
            )
            lines += wrapper.wrap(text)
    return [*lines, ""]


def check_packages(params: Params) -> Iterator[Issue]:
    """Python, the packages that are needed, and those of the loggers that the params name.

    The ranges are those of pyproject.toml in the checkout, which may be newer than what was
    installed.
    """
    pyproject = Path(__file__).parents[2] / "pyproject.toml"
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    loggers = project["optional-dependencies"]["loggers"]
    lines = [
        f"python{project['requires-python']}",
        *project["dependencies"],
        *(line for line in loggers if Requirement(line).name in params.train_head.loggers),
    ]
    return check_required(lines, installed_version)


def installed_version(name: str) -> str | None:
    """The version of Python or of an installed package; None where there is none."""
    if name == "python":
        return ".".join(map(str, sys.version_info[:3]))
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def check_required(
    lines: Sequence[str], version_of: Callable[[str], str | None]
) -> Iterator[Issue]:
    """One issue for all packages within their range, and one for each that is not."""
    good: dict[str, str] = {}
    bad: list[Issue] = []
    for line in lines:
        wanted = Requirement(line)
        name, version = wanted.name, version_of(wanted.name)
        # A build such as 2.13.0+cpu, or a nightly, counts by its number.
        if version and wanted.specifier.contains(version.split("+")[0], prereleases=True):
            good[name] = version
            continue
        text = f"expected {line}, found {version or 'none'}"
        remedy = f"make an environment of {line}" if name == "python" else f"pip install '{line}'"
        bad.append(missing(name, text, remedy))
    shown = ", ".join(f"{name} {good[name]}" for name in _SHOWN if name in good)
    yield ok("packages", f"{len(good)} of {len(lines)} as they should be: {shown}")
    yield from bad


def check_gpu(params: Params) -> Iterator[Issue]:
    """The machine, torch's build, its GPUs, and the attention backend under these params."""
    import torch

    from pipeline.vlm.loading import attention_backend

    yield ok("machine", f"{len(os.sched_getaffinity(0))} cores, {size(memory_bytes())} of memory")
    build = f"torch {torch.__version__}"
    if torch.cuda.is_available():
        yield ok("build", build)
    else:
        yield note("GPU", f"{build} sees none: the CPU does for the demo, not for more", _SEE_GPU)
    for index in range(torch.cuda.device_count()):
        gpu = torch.cuda.get_device_properties(index)
        yield ok(f"cuda:{index}", f"{gpu.name}, {size(gpu.total_memory)}")
    for section in ("extract", "train_head", "evaluate"):
        try:
            device = resolve_device(getattr(params, section).device)
        except ConfigError as error:
            yield missing(f"{section}.device", str(error), f"mend that, or set {section}.device")
            continue
        if section == "extract":
            taken = attention_backend(params.vlm, device)
            text = f"vlm.attention: {params.vlm.attention} takes {taken} on {device}"
            yield ok("attention", text)


def check_checkpoint(params: Params) -> Iterator[Issue]:
    """Check `vlm.checkpoint` and `vlm.adapter`; nothing is downloaded, no weight is read."""
    from pipeline.simulation.demo_recordings import MARKER
    from pipeline.vlm import checkpoint_folder

    vlm = params.vlm
    folder = _local_folder(vlm.checkpoint, vlm.revision)
    if folder is None:
        yield _absent_checkpoint(params)
        return
    try:
        files = checkpoint_folder.weight_files(folder)
        checkpoint_folder.tokenizer_files(folder)
        shapes = checkpoint_folder.tensor_shapes(files)
    except VLMError as error:
        yield missing("vlm.checkpoint", str(error), "copy it or download it again")
        return
    count = sum(map(math.prod, shapes.values()))
    here = f"{folder}, whole, {count:,} parameters"
    if (folder / MARKER).exists():
        here += "; the demo's random weights: to look at the machinery, not to learn from"
        yield note("vlm.checkpoint", here, f"{_EXAMPLE}; docs/real-model.md")
    else:
        yield ok("vlm.checkpoint", here)
    if vlm.adapter is not None:
        adapter = _local_folder(vlm.adapter, None)
        if adapter is None:
            raise VLMError(f"vlm.adapter: {vlm.adapter}: not on this machine")
        checkpoint_folder.adapter_files(adapter)
        yield ok("vlm.adapter", vlm.adapter)
    yield check_fit(count, params)


def _local_folder(checkpoint: str, revision: str | None) -> Path | None:
    """The folder of a checkpoint on this machine, or in its cache of the hub; None without."""
    from pipeline.vlm import checkpoint_folder

    if folder := checkpoint_folder.folder_here(checkpoint):
        return folder
    if not could_be_hub_id(checkpoint):
        return None
    return checkpoint_folder.cached_checkpoint(checkpoint, revision)


def _absent_checkpoint(params: Params) -> Issue:
    """The issue of a checkpoint that is not on this machine."""
    checkpoint, subject = params.vlm.checkpoint, "vlm.checkpoint"
    absent, remedy = f"{checkpoint}: not on this machine", f"hf download {checkpoint}"
    if Path(checkpoint) == params.demo.checkpoint:
        return missing(subject, absent, f"{command('demo')} (or dvc repro)")
    if not could_be_hub_id(checkpoint):
        return missing(subject, f"{absent}, and no hub id", _EXAMPLE)
    return note(subject, f"{absent}; the first extraction downloads it", remedy)


def check_fit(count: int, params: Params) -> Issue:
    """Whether so many weights fit: on the smallest GPU, else into the free memory."""
    import torch

    dtype = params.vlm.dtype
    needed, where, room = count * getattr(torch, dtype).itemsize, "memory", available_bytes()
    text = f"{size(needed)} in {dtype}"
    if torch.cuda.is_available() and params.extract.device != "cpu":
        gpus = map(torch.cuda.get_device_properties, range(torch.cuda.device_count()))
        where, room = "the smallest GPU", min(gpu.total_memory for gpu in gpus) - _BESIDE
    text += f", {where} has room for {size(max(room, 0))}"
    if needed <= room:
        return ok("it fits", text)
    half = "set vlm.dtype to bfloat16, or " if dtype == "float32" else ""
    return note("it may not fit", text, f"{half}take a smaller checkpoint, or a larger machine")


def check_recordings(params: Params) -> Iterator[Issue]:
    """Check `data.root` and each source: its metadata, a few episodes, and one frame a view."""
    from pipeline.data import open_recordings

    data = params.data
    demo = f"{command('demo')} (or dvc repro)" if data.root == params.demo.recordings else ""
    if not data.root.is_dir() and not all(
        Path(path).is_absolute() for source in data.sources for path in source.paths
    ):
        text = f"{data.root}: no such folder"
        yield missing("data.root", text, demo or "set data.root to the folder of recordings")
        return
    for source in data.sources:
        try:
            opened = open_recordings([source], data.root, data.views)
        except (ConfigError, RecordingError) as error:
            yield missing(source.name, str(error), demo or "mend data.sources")
            continue
        formats = Counter(recording.format for recording in opened.recordings)
        text = ", ".join(f"{count} episode(s), {name}" for name, count in formats.items())
        yield ok(source.name, text or "no episode")
        bad = [*(bad.reason for bad in opened.bad), *_unreadable(opened.recordings)]
        if bad:
            first = f"{len(bad)} episode(s) cannot be read, first: {bad[0]}"
            remedy = "mend or remove them, or set data.on_bad_episode=skip"
            yield (note if data.on_bad_episode == "skip" else missing)(source.name, first, remedy)
        if opened.missing:
            text = f"{len(opened.missing)} listed episode(s) are not there: {opened.missing[0]}"
            yield note(source.name, text, "copy them too, or leave them out")


def _unreadable(recordings: "Sequence[Recording]") -> Iterator[str]:
    """Reads a few evenly spread recordings; yields why one cannot be read."""
    spread = np.linspace(0, len(recordings) - 1, min(_EPISODES, len(recordings)))
    for recording in (recordings[int(place)] for place in spread):
        try:
            motion = recording.poses if recording.has_poses else recording.action
            for read in (recording.state, recording.sensor, motion):
                read()
            for camera in recording.cameras().values():
                camera.check(range(min(1, len(camera.time))))
        except RecordingError as error:
            yield str(error)


GROUPS: dict[str, Callable[[Params], Iterator[Issue]]] = {
    "Python and packages": check_packages,
    "GPU": check_gpu,
    "Vision-language model": check_checkpoint,
    "Recordings": check_recordings,
}
"""Title -> the checks of a group."""
