"""Decode and prepare missing rows in the background, while the model works."""

import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.data import Recording
from pipeline.data.row_range import RowRange
from pipeline.store import RowSource
from pipeline.vlm.feature_spec import FeatureSpec, row_key
from pipeline.vlm.preparation import PreparedRow, Preparer

Work = TypeVar("Work")
Made = TypeVar("Made")

SPAN_ROWS = 16
"""Rows that one thread decodes in one go: long enough for video, short enough for memory.

Variants count as rows of their own here: they wait in memory alike.
"""


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
    variants: tuple[PreparedRow, ...]
    """The frames as they are, then augmented; all of one shape."""
    where: str
    """Recording and row, for messages."""


@dataclass(frozen=True)
class RepeatedRow:
    """A row that shows and says what another row of this run does."""

    row: int
    key: bytes
    first: int
    """The row of the same key that the model is given."""


def spans_of(
    recordings: Sequence[Recording],
    vl_start: NDArray[np.int64],
    frame_time: NDArray[np.float64],
    views: Sequence[str],
    missing: NDArray[np.int64],
    variants: int,
) -> Iterator[RowRange]:
    """Cut the missing rows into spans of `SPAN_ROWS` prepared rows, `variants` of each.

    By the frame times that the layout wrote, so that a resumed build needs no stream.
    """
    together = max(1, SPAN_ROWS // variants)
    for episode, recording in enumerate(recordings):
        first, last = np.searchsorted(missing, vl_start[episode : episode + 2])
        if first == last:
            continue
        cameras = recording.cameras()
        for start in range(first, last, together):
            rows = missing[start : min(start + together, last)]
            yield RowRange.of(recording, cameras, rows, frame_time[rows], views)


class RowPreparation:
    """Turns spans into rows; used from several threads."""

    def __init__(self, preparer: Preparer, spec: FeatureSpec, donors: Sequence[RowSource]) -> None:
        self._preparer = preparer
        self._spec = spec
        self._donors = donors
        self._firsts: dict[bytes, int] = {}
        self._lock = threading.Lock()

    def prepare(self, span: RowRange) -> list[KnownRow | ReadyRow]:
        """The rows of a span, each decoded frame held only while its row is made."""
        return [
            self._known(row, key) or self._ready(span, row, key, frames)
            for row, key, frames in self._keyed(span)
        ]

    def prepare_once(self, span: RowRange) -> list[KnownRow | ReadyRow | RepeatedRow]:
        """As `prepare`, but of all rows of equal key only one is made ready."""
        return [
            self._known(row, key) or self._repeated(row, key) or self._ready(span, row, key, frames)
            for row, key, frames in self._keyed(span)
        ]

    def _keyed(self, span: RowRange) -> Iterator[tuple[int, bytes, dict[str, NDArray[np.uint8]]]]:
        prompt = self._preparer.render(span.recording.instruction, list(span.frames))
        for row, frames in span.read():
            yield row, row_key(self._spec, prompt, frames), frames

    def _known(self, row: int, key: bytes) -> KnownRow | None:
        with self._lock:
            for donor in self._donors:
                features = donor.take(key)
                if features is not None:
                    return KnownRow(row, key, features, donor.environment_of(key))
        return None

    def _repeated(self, row: int, key: bytes) -> RepeatedRow | None:
        with self._lock:
            first = self._firsts.setdefault(key, row)
        return RepeatedRow(row, key, first) if first != row else None

    def _ready(
        self, span: RowRange, row: int, key: bytes, frames: dict[str, NDArray[np.uint8]]
    ) -> ReadyRow:
        variants = self._preparer.prepare_variants(span.recording.instruction, frames, key)
        return ReadyRow(row, key, variants, f"{span.recording.path}, VL row {row}")


def in_background(
    work: Iterable[Work],
    make: Callable[[Work], list[Made]],
    threads: int,
    ahead: Callable[[], int] = lambda: 0,
) -> Generator[Made]:
    """`make` of each piece of work, in order, as many pieces before the reader as `ahead` says.

    At least `threads + 1`, so that no thread waits for the reader.
    """
    with ThreadPoolExecutor(threads, thread_name_prefix="decode") as pool:
        pieces = iter(work)
        made: deque[Future[list[Made]]] = deque()
        try:
            while True:
                lacking = max(threads + 1, ahead()) - len(made)  # below 0 once `ahead` has shrunk
                made.extend(pool.submit(make, piece) for piece in islice(pieces, max(0, lacking)))
                if not made:
                    return
                yield from made.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)
