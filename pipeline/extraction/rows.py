"""Decode and prepare missing rows in the background, while the model works."""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.recordings import CameraStream, Recording
from pipeline.store import Donor
from pipeline.timeline import last_at
from pipeline.vlm.feature_spec import FeatureSpec, row_key
from pipeline.vlm.preparation import PreparedRow, Preparer

Work = TypeVar("Work")
Made = TypeVar("Made")

SPAN_ROWS = 16
"""Rows that one thread decodes in one go: long enough for video, short enough for memory."""


@dataclass(frozen=True)
class Span:
    """Consecutive missing rows of one episode and the frame of each view for each."""

    recording: Recording
    cameras: Mapping[str, CameraStream]
    """Opened once an episode: listing its frames costs time."""
    rows: NDArray[np.int64]
    """Store-global VL rows."""
    frames: Mapping[str, NDArray[np.int64]]


@dataclass(frozen=True)
class KnownRow:
    """A row that a donor has."""

    row: int
    key: bytes
    features: NDArray[Any]
    environment: dict[str, Any]


@dataclass(frozen=True)
class ReadyRow:
    """A row ready for the model."""

    row: int
    key: bytes
    prepared: PreparedRow
    where: str
    """Recording and row, for messages."""


def spans_of(
    recordings: Sequence[Recording],
    vl_start: NDArray[np.int64],
    frame_time: NDArray[np.float64],
    views: Sequence[str],
    missing: NDArray[np.int64],
) -> Iterator[Span]:
    """Cut the missing rows into spans.

    Which frame a row shows follows from the frame times that the layout wrote, so that a resumed
    build needs no stream.
    """
    for episode, recording in enumerate(recordings):
        first, last = np.searchsorted(missing, vl_start[episode : episode + 2])
        if first == last:
            continue
        cameras = recording.cameras()
        for start in range(first, last, SPAN_ROWS):
            rows = missing[start : min(start + SPAN_ROWS, last)]
            frames = {
                view: last_at(cameras[view].time, frame_time[rows, column])
                for column, view in enumerate(views)
                if np.isfinite(frame_time[rows[0], column])
            }
            yield Span(recording, cameras, rows, frames)


class RowPreparation:
    """Turns spans into rows; used from several threads."""

    def __init__(self, preparer: Preparer, spec: FeatureSpec, donors: Sequence[Donor]) -> None:
        self._preparer = preparer
        self._spec = spec
        self._donors = donors
        self._donors_lock = threading.Lock()

    def prepare(self, span: Span) -> list[KnownRow | ReadyRow]:
        """The rows of a span, each decoded frame held only while its row is made."""
        recording = span.recording
        readers = {
            view: span.cameras[view].read(frames.tolist()) for view, frames in span.frames.items()
        }
        prompt = self._preparer.render(recording.instruction, list(span.frames))
        made: list[KnownRow | ReadyRow] = []
        for row in span.rows.tolist():
            frames = {view: next(reader) for view, reader in readers.items()}
            key = row_key(self._spec, prompt, frames)
            known = self._known(row, key)
            made.append(
                known
                or ReadyRow(
                    row,
                    key,
                    self._preparer.prepare(recording.instruction, frames),
                    f"{recording.path}, VL row {row}",
                )
            )
        return made

    def _known(self, row: int, key: bytes) -> KnownRow | None:
        with self._donors_lock:
            for donor in self._donors:
                features = donor.take(key)
                if features is not None:
                    return KnownRow(row, key, features, donor.environment_of(key))
        return None


def in_background(
    work: Iterable[Work], make: Callable[[Work], list[Made]], threads: int
) -> Iterator[Made]:
    """`make` of each piece of work, in order, up to `threads + 1` pieces ahead of the reader."""
    with ThreadPoolExecutor(threads, thread_name_prefix="decode") as pool:
        ahead: deque[Future[list[Made]]] = deque()
        try:
            for piece in work:
                ahead.append(pool.submit(make, piece))
                if len(ahead) > threads:
                    yield from ahead.popleft().result()
            while ahead:
                yield from ahead.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)
