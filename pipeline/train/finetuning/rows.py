"""Batches of a store with the VL rows that a live model sees, decoded from the recordings.

In a video every frame since a key frame has to be decoded, so rows of one episode are read together
and in order, and prepared rows are kept.
"""

import threading
import time
from collections import deque
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.data import Recording
from pipeline.data.episode import RowFrames, by_episode
from pipeline.policy.observation import LiveObservation
from pipeline.store import Batch, FeatureStore
from pipeline.train.batches import BatchIndices, Prefetch, Windows
from pipeline.vlm.preparation import PreparedRow, Preparer

CACHE_BYTES = 2**30
"""Bytes of prepared rows that are kept: a small data set is decoded once."""
_OPEN_EPISODES = 1024
"""Episodes whose cameras and lists of frames are kept open."""


class LiveRows:
    """Prepared rows by their number in the store; used from several threads."""

    def __init__(
        self,
        store: FeatureStore,
        recordings: Sequence[Recording],
        preparer: Preparer,
        cache_bytes: int = CACHE_BYTES,
    ) -> None:
        """`recordings` are those of the store's episodes, in its order."""
        self.vl_start = store.array("episode/vl_start")
        frame_time, views = store.array("vl/frame_time"), store.spec["views"]
        self._frames = RowFrames(recordings, self.vl_start, frame_time, views, _OPEN_EPISODES)
        self._preparer = preparer
        self._kept: dict[int, PreparedRow] = {}
        self._room = cache_bytes
        self._lock = threading.Lock()

    def prepare(self, rows: NDArray[np.int64]) -> list[PreparedRow]:
        """Prepare these ascending rows; those of one episode are read in one pass, never backwards.

        Raises `RecordingError` where a frame cannot be decoded.
        """
        kept = {row: self._kept.get(row) for row in rows.tolist()}
        prepared = {row: known for row, known in kept.items() if known is not None}
        absent = np.array([row for row in kept if row not in prepared], np.int64)
        for row_range in self._frames.ranges(absent):
            for row, frames in row_range.read():
                prepared[row] = self._preparer.prepare(row_range.recording.instruction, frames)
                self._keep(row, prepared[row])
        return [prepared[row] for row in rows.tolist()]

    def _keep(self, row: int, prepared: PreparedRow) -> None:
        """Keep a row, in place of the rows that were kept first."""
        with self._lock:
            if row not in self._kept:
                self._kept[row] = prepared
                self._room -= prepared.pixels.nbytes
            while self._room < 0:
                oldest = next(iter(self._kept))
                self._room += self._kept.pop(oldest).pixels.nbytes


@dataclass
class LiveBatch(Batch, LiveObservation):
    """A batch, and the distinct rows from which its features are computed."""


class LiveFeed(Prefetch):
    """Yields `(indices, live batch)` for each entry of a plan, in its order.

    `threads` threads decode the distinct VL rows of each batch, `threads` batches ahead. Only plain
    frames are decoded: other variants exist in the store alone. `next` raises an exception of a
    recording at the batch it belongs to.
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
        self._rows = rows
        self._decoding: deque[tuple[NDArray[np.int64], list[Future[list[PreparedRow]]]]] = deque()
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="decode")
        announced = (self._announce(indices) for indices in plan)
        super().__init__(store, announced, windows, device, buffers=threads + 1)

    def __next__(self) -> tuple[BatchIndices, LiveBatch]:
        indices, batch = super().__next__()
        started = time.perf_counter()
        row_of, decoded = self._decoding.popleft()
        rows = [row for future in decoded for row in future.result()]
        self.waited_s += time.perf_counter() - started
        places = torch.from_numpy(row_of).to(batch.features.device)
        return indices, LiveBatch(**vars(batch), rows=rows, row_of=places)

    def close(self) -> None:
        """Stop all threads and wait for them."""
        super().close()
        self._pool.shutdown(cancel_futures=True)

    def _announce(self, indices: BatchIndices) -> BatchIndices:
        """Start to decode the rows of a batch; runs in the thread that consumes the plan."""
        episode = self._store.episode_of(indices.ticks)
        seen = self._store.gatherer.vl_rows(indices.ticks, episode, indices.lags.features)
        distinct, row_of = np.unique(seen, return_inverse=True)
        parts = by_episode(distinct, self._rows.vl_start)
        decoded = [self._pool.submit(self._rows.prepare, rows) for _, rows in parts]
        self._decoding.append((row_of.astype(np.int64), decoded))
        return indices
