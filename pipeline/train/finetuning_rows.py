"""The recordings that a store was extracted from, and the VL rows that a live model sees of them.

The recordings are opened again and compared with the store. In a video every frame since a key
frame has to be decoded, so rows of one episode are read together and in order, and prepared rows
are kept.
"""

import threading
import time
from collections import deque
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.config import Params
from pipeline.base.digests import ContentDigests, ledger_path
from pipeline.base.errors import RecordingError, StoreMismatch
from pipeline.base.printed_commands import command
from pipeline.data import Opened, Recording, content_digest, open_recordings
from pipeline.data.episode import RowFrames, by_episode
from pipeline.policy.observation import LiveObservation
from pipeline.store import Batch, Episode, FeatureStore, episode_name
from pipeline.train.batches import BatchIndices, Prefetch, Windows
from pipeline.train.training_data import list_differences
from pipeline.vlm.feature_spec import FeatureSpec, feature_spec
from pipeline.vlm.preparation import PreparedRow, Preparer

_SHOWN = 5
"""Episodes that an error lists."""
CACHE_BYTES = 2**30
"""Bytes of prepared rows that are kept: a small data set is decoded once."""
_OPEN_EPISODES = 1024
"""Episodes whose cameras and lists of frames are kept open."""


def find_recordings(store: FeatureStore, params: Params) -> tuple[Recording, ...]:
    """The recording of each episode of the store, in its order, by source and id.

    Only the store's views are kept. Reads metadata only. Raises `StoreMismatch` naming the
    episodes that `data.sources` no longer have.
    """
    opened = open_recordings(params.data.sources, params.data.root, store.spec["views"])
    known = {(recording.source, recording.id): recording for recording in opened.recordings}
    missing = [episode for episode in store.episodes if (episode.source, episode.id) not in known]
    if missing:
        _refuse(store, [(episode, _why_missing(episode, opened)) for episode in missing])
    return tuple(known[episode.source, episode.id] for episode in store.episodes)


def check_recordings(
    store: FeatureStore, recordings: Sequence[Recording], digests: ContentDigests
) -> None:
    """Raise `StoreMismatch` where a recording is not what it was when the store was extracted.

    `recordings` are those of `find_recordings`. Files whose digest is not known yet are read.
    """
    changed: list[tuple[Episode, str]] = []
    pairs = list(zip(store.episodes, recordings, strict=True))
    for episode, recording in tqdm(pairs, "check", unit="episode", disable=None, leave=False):
        try:
            if content_digest(recording, digests.of) != episode.content:
                changed.append((episode, f"the files in {recording.path} changed since extraction"))
            elif recording.instruction != episode.instruction:
                before, now = repr(episode.instruction), repr(recording.instruction)
                changed.append((episode, f"its instruction was {before} at extraction, {now} now"))
        except RecordingError as error:
            changed.append((episode, str(error)))
    if changed:
        _refuse(store, changed)


def check_spec(store: FeatureStore, params: Params, digests: ContentDigests) -> FeatureSpec:
    """The store's feature spec, after a check that `vlm` gives the same.

    Raises `StoreMismatch` with the entries that differ, and `VLMError` where the checkpoint cannot
    be used.
    """
    stored = store.spec
    spec = feature_spec(params.vlm, stored["storage_dtype"], stored["views"], digests.of)
    if spec.digest != stored["digest"]:
        raise StoreMismatch(
            f"{store.path}: tuning begins with the model whose features the store holds, but its "
            f"feature spec is not that of vlm (store -> vlm):\n"
            f"{list_differences(stored, spec.attrs())}\n"
            "Set vlm to what the store was extracted with, name another store in "
            f"train_head.store, or extract one with these params: {command('extract')}"
        )
    return spec


def known_digests(store: FeatureStore) -> "closing[ContentDigests]":
    """The ledger of digests that extraction keeps beside a store; closed at the end of a `with`."""
    return closing(ContentDigests(ledger_path(store.path)))


def _why_missing(episode: Episode, opened: Opened) -> str:
    for bad in opened.bad:
        if bad.source == episode.source and bad.where.name == episode.id.rpartition("/")[2]:
            return bad.reason
    return f"no source has it; it was extracted from {episode.path}, relative to data.root"


def _refuse(store: FeatureStore, wrong: Sequence[tuple[Episode, str]]) -> None:
    lines = "\n".join(f"  {episode_name(episode)}: {why}" for episode, why in wrong[:_SHOWN])
    raise StoreMismatch(
        f"{store.path}: expected the recordings that the store was extracted from, but of its "
        f"{len(store.episodes)} episodes {len(wrong)} cannot be found as they were, the first:\n"
        f"{lines}\nPut the recordings back (data.root, data.sources), or extract a store of what "
        f"is there now: {command('extract')}"
    )


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
