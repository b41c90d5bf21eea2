"""Batches one after the other, as a training takes them: a thread against worker processes."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from pipeline.store import FeatureStore
from pipeline.train.batches import BatchIndices, Prefetch, Windows

_BATCH = 64
_SKIPPED = 4
"""Batches that do not count: the first ones wait for threads, processes and page faults."""


class StoreBatches(Dataset[Any]):
    """Whole batches of a store by their number, for the workers of a DataLoader."""

    def __init__(self, store: FeatureStore, ticks: list[NDArray[np.int64]], windows: Windows):
        self._store, self._ticks, self._windows = store, ticks, windows

    def __len__(self) -> int:
        return len(self._ticks)

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        wanted = (self._windows.horizon, self._windows.sensor_window, self._windows.state_window)
        return vars(self._store.gather(self._ticks[index], *wanted))


def stream_rates(store: FeatureStore, length: int, batches: int) -> dict[str, dict[str, float]]:
    """Batches a second of each way when nothing else is done, and when a step takes 5 ms.

    `wait_ms` is what a step waits for its batch in the second case, in the median.
    """
    rng = np.random.default_rng(0)
    ticks = [rng.integers(store.ticks // 8, store.ticks, _BATCH) for _ in range(batches)]
    windows = Windows(8, length, 100)

    def prefetch() -> Iterator[object]:
        cpu = torch.device("cpu")
        with Prefetch(store, (BatchIndices(each) for each in ticks), windows, cpu) as feed:
            yield from feed

    def loader() -> Iterator[object]:
        dataset = StoreBatches(store, ticks, windows)
        yield from DataLoader(
            dataset, batch_size=None, num_workers=2, multiprocessing_context="fork"
        )

    ways: dict[str, Callable[[], Iterator[object]]] = {
        "prefetch thread": prefetch,
        "DataLoader, 2 workers": loader,
    }
    return {
        name: {
            "batches_per_s": (batches - _SKIPPED) / sum(waits(make(), 0.0)),
            "wait_ms": 1e3 * float(np.median(waits(make(), 0.005))),
        }
        for name, make in ways.items()
    }


def waits(batches: Iterable[object], step_s: float) -> list[float]:
    """Seconds that each batch was waited for by steps that take `step_s`."""
    taken: list[float] = []
    iterator = iter(batches)
    with closing(iterator):  # type: ignore[type-var]
        while True:
            begun = time.perf_counter()
            try:
                next(iterator)
            except StopIteration:
                return taken[_SKIPPED:]
            taken.append(time.perf_counter() - begun)
            time.sleep(step_s)
