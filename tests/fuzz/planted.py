"""Faults planted in the pipeline, one for each way in which a case can end wrongly.

A suite that cannot fail is worth nothing: each of them must be reported in its column.
"""

import ctypes
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import pipeline.policy.checkpoint as checkpoint
from pipeline.base.errors import CheckpointIncomplete
from pipeline.data.raw import RawRecording
from pipeline.policy.policy import Policy
from pipeline.store import StoreBuild, verification
from pipeline.store.chunks import note_metadata
from pipeline.store.paths import group_attributes
from tests.fuzz.cases import Case
from tests.fuzz.mutations import rewrite
from tests.fuzz.runner import run_cases


def unreported(corpus: Path, jobs: int) -> list[str]:
    """The planted faults that the suite does not report in their column."""
    cases = [
        Case(-2, number, corpus, WHOLES[whole], plant, seconds=2.0)
        for number, (whole, _, plant) in enumerate(FAULTS.values())
    ]
    expected = [f"{name}: expected {outcome}" for name, (_, outcome, _) in FAULTS.items()]
    return [
        f"{expected[verdict.case.number]}, found {verdict}"
        for verdict in run_cases(cases, jobs)
        if not expected[verdict.case.number].endswith(f" {verdict.outcome}")
    ]


def _plant(owner: Any, name: str, make: Callable[[Any], Callable[..., Any]]) -> Callable[[], None]:
    """What puts a function, made of the one that is there, in its place."""
    return lambda: setattr(owner, name, make(getattr(owner, name)))


def _sensor(work: Callable[[Any], Any]) -> Callable[[], None]:
    """Put something in the place of what reads the sensor of a raw recording."""
    return _plant(RawRecording, "sensor", lambda read: lambda recording: work(read(recording)))


def _refuse(message: str) -> Callable[[], None]:
    """Have every head refused so."""

    def refuse(folder: Path) -> Any:
        raise CheckpointIncomplete(message)

    return _plant(checkpoint, "load_policy", lambda load: refuse)


def _raise(stream: Any) -> Any:
    raise KeyError("forces")


def _spin(stream: Any) -> Any:
    while True:
        time.thread_time()


def _blind(verify: Any) -> Any:
    """A store with a damaged chunk, and a check that looks at no chunk."""

    def check(path: Path, *arguments: Any) -> Any:
        chunk = path / "tick/action/c/0/0"
        rewrite(chunk, bytes([1]) + chunk.read_bytes()[1:])
        return replace(verify(path, *arguments), issues=())

    return check


def _altered(load: Any) -> Any:
    """Weights that are not those of the file."""
    more = lambda weights: {name: tensor + 1 for name, tensor in weights.items()}  # noqa: E731
    return lambda policy, weights: load(policy, more(weights))


def _unreadable(seal: Any) -> Any:
    """A store that zarr reads and its own readers refuse."""

    def strange(build: Any, **options: Any) -> None:
        seal(build, **options)
        note_metadata(build.target, group_attributes(build.target) | {"vlm_reuse_count": 0})

    return strange


WHOLES = {
    "raw": ("raw", "read"),
    "extraction": ("raw", "extract"),
    "store": ("store", "verify"),
    "head": ("head", "load"),
}
FAULTS: dict[str, tuple[str, str, Callable[[], object]]] = {
    "a sensor of zeros": ("raw", "wrong", _sensor(lambda s: replace(s, values=0 * s.values))),
    "a blind check of a store": ("store", "wrong", _plant(verification, "verify", _blind)),
    "a store that nothing reads": (
        "extraction",
        "wrong",
        _plant(StoreBuild, "seal", _unreadable),
    ),
    "a refusal by the limit of memory": (
        "head",
        "over memory",
        _refuse("head: not enough memory for it. Copy it again."),
    ),
    "weights of another head": ("head", "wrong", _plant(Policy, "load_state_dict", _altered)),
    "a KeyError": ("raw", "traceback", _sensor(_raise)),
    "a loop": ("raw", "hang", _sensor(_spin)),
    "a segmentation fault": ("raw", "crash", _sensor(lambda stream: ctypes.string_at(0))),
    "3 GiB": ("raw", "over memory", _sensor(lambda stream: np.ones(3 * 2**27))),
    "a refusal without a mend": ("head", "unclear", _refuse("head: something is wrong.")),
    "a refusal without a file": ("head", "unclear", _refuse("it is wrong. Copy it again.")),
}
"""By name: which thing, in which column it must be reported, and what breaks the pipeline."""
