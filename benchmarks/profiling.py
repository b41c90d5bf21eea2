"""Where stage one's time goes: by step on the CPU, by kernel on a GPU."""

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from typing import Any
from unittest.mock import patch

import torch
from torch.profiler import ProfilerActivity, profile

from benchmarks.timing import Work
from pipeline.data.episode import RowRange
from pipeline.store import StoreBuild
from pipeline.vlm.qwen import Extractor
from pipeline.vlm.vision import VisionTower

_STEPS: tuple[tuple[str, Any, str], ...] = (
    ("key", "pipeline.base.provenance", "row_key"),
    ("resize", "pipeline.vlm.preparation", "stretch"),
    ("collate", Extractor, "collate"),
    ("patchify", "pipeline.vlm.qwen", "patchify"),
    ("vision tower", VisionTower, "__call__"),
    ("decoder", Extractor, "_read"),
    ("pooling", "pipeline.vlm.qwen", "pool"),
    ("write", StoreBuild, "write_features"),
    ("mark", StoreBuild, "mark"),
)
"""Each step, and the function that is it."""

_KERNELS = 15


class Stopwatch:
    """Seconds a step, without those of the steps that it calls; for several threads."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._inner = threading.local()
        self._lock = threading.Lock()

    @contextmanager
    def step(self, name: str) -> Generator[None]:
        """Within it the step's watch runs."""
        outer = getattr(self._inner, "seconds", 0.0)
        self._inner.seconds = 0.0
        begun = time.perf_counter()
        try:
            yield
        finally:
            taken = time.perf_counter() - begun
            with self._lock:
                self.seconds[name] += taken - self._inner.seconds
            self._inner.seconds = outer + taken

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, on the step's watch."""

        @wraps(function)
        def call(*given: Any, **named: Any) -> Any:
            with self.step(name):
                return function(*given, **named)

        return call


def stopwatch_table(work: Work) -> dict[str, float]:
    """Seconds of each step of stage one while `work` runs, and of the whole.

    Steps in the background run beside the model, so their sum may exceed the whole.
    """
    watch = Stopwatch()
    read = RowRange.read

    def timed_read(rows: RowRange) -> Iterator[Any]:
        frames = read(rows)
        while True:
            with watch.step("decode"):
                row = next(frames, None)
            if row is None:
                return
            yield row

    with ExitStack() as stack:
        stack.enter_context(patch.object(RowRange, "read", timed_read))
        for name, owner, attribute in _STEPS:
            found = __import__(owner, fromlist=["_"]) if isinstance(owner, str) else owner
            timed = watch.timed(name, getattr(found, attribute))
            stack.enter_context(patch.object(found, attribute, timed))
        begun = time.perf_counter()
        work()
        whole = time.perf_counter() - begun
    order = sorted(watch.seconds, key=lambda name: -watch.seconds[name])
    return {name: round(watch.seconds[name], 4) for name in order} | {"wall": round(whole, 4)}


def kernel_table(work: Work) -> dict[str, float]:
    """Seconds on the GPU of the kernels that took most while `work` ran, of all, and the wall's.

    What the sum lacks to the wall is time in which the GPU had nothing to do.
    """
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiler:
        begun = time.perf_counter()
        work()
        torch.cuda.synchronize()
        whole = time.perf_counter() - begun
    events = [one for one in profiler.key_averages() if one.device_type.name == "CUDA"]
    events.sort(key=lambda one: -one.self_device_time_total)
    table = {one.key[:80]: round(one.self_device_time_total / 1e6, 4) for one in events[:_KERNELS]}
    every = sum(one.self_device_time_total for one in events) / 1e6
    return table | {"all kernels": round(every, 4), "wall": round(whole, 4)}
