"""How fast a run goes and how much memory it takes."""

import resource
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager
from typing import NamedTuple

import torch

from pipeline.train.batches import Feed


class Pace(NamedTuple):
    """A reading of `Speed`."""

    steps_per_s: float
    """Since the reading before."""
    data_wait_share: float
    """Of that time, spent waiting for batches."""
    peak_memory: int
    """See `peak_memory_bytes`."""
    trained_s: float
    """Seconds of training so far, over all starts of the run."""


class Speed:
    """A stopwatch of training: steps and their data, not evaluations and checkpoints."""

    def __init__(
        self, feed: Feed, device: torch.device, step: int = 0, trained_s: float = 0.0
    ) -> None:
        self._feed, self._device = feed, device
        self._step, self._waited = step, feed.waited_s
        self._before, self._at_reading = trained_s, trained_s
        self._since: float | None = time.perf_counter()

    @property
    def trained_s(self) -> float:
        """Seconds of training so far, over all starts of the run."""
        running = 0.0 if self._since is None else time.perf_counter() - self._since
        return self._before + running

    @contextmanager
    def paused(self) -> Generator[None]:
        """Within it the watch stands still."""
        self._before, self._since = self.trained_s, None
        yield
        self._since = time.perf_counter()

    def read(self, step: int) -> Pace:
        """The figures at this step."""
        trained, waited = self.trained_s, self._feed.waited_s
        elapsed = max(trained - self._at_reading, 1e-9)
        pace = Pace(
            (step - self._step) / elapsed,
            (waited - self._waited) / elapsed,
            peak_memory_bytes(self._device),
            trained,
        )
        self._step, self._waited, self._at_reading = step, waited, trained
        return pace


def peak_memory_bytes(device: torch.device) -> int:
    """The most that this process has held: allocated on its GPU, else resident in memory.

    What is resident includes the pages of the store that are mapped and in memory.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
