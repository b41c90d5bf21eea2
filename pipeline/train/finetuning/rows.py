"""VL rows of a store as the model takes them, decoded from the recordings when they are asked for.

Any frame of a folder of JPEG files costs the same, but in a video every frame since a key frame has
to be decoded: so rows of one episode are read together and in order, and prepared rows are kept.
"""

import threading
from collections import OrderedDict
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.data import CameraStream, Recording
from pipeline.data.row_range import RowRange
from pipeline.store import FeatureStore
from pipeline.vlm.preparation import PreparedRow, Preparer

CACHE_BYTES = 2**30
"""Of prepared rows that are kept: all of a small data set, so that it is decoded once."""
_OPEN_EPISODES = 1024
"""Whose lists of frames are kept."""


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
        self._recordings = recordings
        self._preparer = preparer
        self._views: list[str] = store.spec["views"]
        self._instructions = [episode.instruction for episode in store.episodes]
        self._vl_start = store.array("episode/vl_start")
        self._frame_time = store.array("vl/frame_time")
        self._cameras = lru_cache(_OPEN_EPISODES)(self._open_cameras)
        self._kept: OrderedDict[int, PreparedRow] = OrderedDict()
        self._room = cache_bytes
        self._lock = threading.Lock()

    def by_episode(self, rows: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Distinct rows in pieces of one episode each, ascending: what is best decoded together."""
        distinct = np.unique(rows)
        episodes = np.searchsorted(self._vl_start, distinct, side="right") - 1
        return np.split(distinct, np.flatnonzero(np.diff(episodes)) + 1)

    def prepare(self, rows: NDArray[np.int64]) -> list[PreparedRow]:
        """Rows of one episode, ascending.

        In one pass through each of its videos, which is never read backwards. Raises
        `RecordingError` where a frame cannot be decoded.
        """
        found = {row: kept for row in rows.tolist() if (kept := self._take(row)) is not None}
        absent = np.array([row for row in rows.tolist() if row not in found], np.int64)
        if len(absent):
            found |= self._decode(absent)
        return [found[row] for row in rows.tolist()]

    def _decode(self, rows: NDArray[np.int64]) -> dict[int, PreparedRow]:
        episode = int(np.searchsorted(self._vl_start, rows[0], side="right")) - 1
        cameras = self._cameras(episode)
        shown = self._frame_time[rows]
        span = RowRange.of(self._recordings[episode], cameras, rows, shown, self._views)
        made: dict[int, PreparedRow] = {}
        for row, frames in span.read():
            made[row] = self._preparer.prepare(self._instructions[episode], frames)
            self._keep(row, made[row])
        return made

    def _open_cameras(self, episode: int) -> dict[str, CameraStream]:
        return dict(self._recordings[episode].cameras())

    def _take(self, row: int) -> PreparedRow | None:
        with self._lock:
            if row in self._kept:
                self._kept.move_to_end(row)
            return self._kept.get(row)

    def _keep(self, row: int, prepared: PreparedRow) -> None:
        """Keep a row in place of those that were not asked for the longest."""
        with self._lock:
            if row in self._kept:
                return
            self._kept[row] = prepared
            self._room -= prepared.pixels.nbytes
            while self._room < 0:
                _, oldest = self._kept.popitem(last=False)
                self._room += oldest.pixels.nbytes
