"""Batches of a store with the rows that a live model has to see beside them."""

import time
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from pipeline.policy.observation import LiveObservation
from pipeline.store import Batch, FeatureStore
from pipeline.train.batches import BatchIndices, Prefetch, Windows
from pipeline.train.finetuning.rows import LiveRows
from pipeline.vlm.preparation import PreparedRow


@dataclass
class LiveBatch(Batch, LiveObservation):
    """A batch and the rows that its features are to be computed from, each distinct one once."""


@dataclass(frozen=True)
class _Coming:
    """A draw whose rows are being prepared."""

    row_of: Int64[Tensor, " batch"]
    rows: list[Future[list[PreparedRow]]]


class LiveFeed(Iterator[tuple[BatchIndices, LiveBatch]]):
    """A `Feed` that hands out `(draw, live batch)` for each draw of a plan, in its order.

    Streams come from a `Prefetch`; the distinct VL rows of each draw are decoded by `threads`
    threads, as many draws ahead. Every variant of a row is the plain frames: what `variants` of a
    draw asks for exists in the store only. An exception in the plan, the store or a recording comes
    out of `next` at the batch it belongs to. Use as a context manager, or call `close`.
    """

    def __init__(
        self,
        store: FeatureStore,
        rows: LiveRows,
        plan: Iterable[BatchIndices],
        windows: Windows,
        device: torch.device,
        threads: int,
    ) -> None:
        self._vl_row = store.array("tick/vl_row")
        self._rows = rows
        self._coming: deque[_Coming] = deque()
        self.waited_s = 0.0
        """Time that the consumer has spent waiting for data."""
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="decode")
        announced = (self._announce(draw) for draw in plan)
        self._prefetch = Prefetch(store, announced, windows, device, buffers=threads + 1)

    def __next__(self) -> tuple[BatchIndices, LiveBatch]:
        started = time.perf_counter()
        draw, batch = next(self._prefetch)
        coming = self._coming.popleft()
        rows = [row for future in coming.rows for row in future.result()]
        self.waited_s += time.perf_counter() - started
        row_of = coming.row_of.to(batch.features.device)
        return draw, LiveBatch(**vars(batch), rows=rows, row_of=row_of)

    def close(self) -> None:
        """Stop all threads and wait for them."""
        self._prefetch.close()
        self._pool.shutdown(cancel_futures=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def _announce(self, draw: BatchIndices) -> BatchIndices:
        """Begin with the rows of a draw; called in the thread that consumes the plan, in order."""
        distinct, row_of = np.unique(self._vl_row[draw.ticks], return_inverse=True)
        pieces = self._rows.by_episode(distinct)
        futures = [self._pool.submit(self._rows.prepare, piece) for piece in pieces]
        self._coming.append(_Coming(torch.from_numpy(row_of.astype(np.int64)), futures))
        return draw
