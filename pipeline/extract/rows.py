"""Row ranges -> rows ready for the model, decoded and prepared in the background."""

import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from typing import Any, TypeVar

from numpy.typing import NDArray

from pipeline.data.row_range import Frames, RowRange
from pipeline.store import RowSource
from pipeline.vlm.feature_spec import FeatureSpec, row_key
from pipeline.vlm.preparation import PreparedRow, Preparer

Work = TypeVar("Work")
Made = TypeVar("Made")

# Rows that one thread decodes in one go: long enough for video, short enough for memory.
#
# Variants count as rows of their own here: they wait in memory alike.
RANGE_ROWS = 16


@dataclass(frozen=True)
class KnownRow:
    """A row that an older store or build has."""

    row: int
    key: bytes
    features: NDArray[Any]
    environment: dict[str, Any]


@dataclass(frozen=True)
class ReadyRow:
    """A row ready for the model: its frames as they are, then augmented; all of one shape.

    `where` is recording and row, for messages.
    """

    row: int
    key: bytes
    variants: tuple[PreparedRow, ...]
    where: str


@dataclass(frozen=True)
class RepeatedRow:
    """A row that shows and says what another, `first`, does: that one the model is given."""

    row: int
    key: bytes
    first: int


Row = KnownRow | ReadyRow | RepeatedRow


class RowPreparation:
    """Turns row ranges into rows; used from several threads."""

    def __init__(self, preparer: Preparer, spec: FeatureSpec, known: Sequence[RowSource]) -> None:
        """A row of a key that one of `known` has is taken from there."""
        self._preparer = preparer
        self._spec = spec
        self._known = known
        self._lock = threading.Lock()

    def prepare(self, rows: RowRange, firsts: dict[bytes, int] | None = None) -> list[Row]:
        """The rows of a range, each decoded frame held only while its row is made.

        Of all rows of equal key only the one that `firsts` notes is made ready; where that is None,
        all are. Raises what the recording raises.
        """
        prompt = self._preparer.render(rows.recording.instruction, list(rows.frames))
        return [self._row(rows, row, frames, prompt, firsts) for row, frames in rows.read()]

    def _row(
        self, rows: RowRange, row: int, frames: Frames, prompt: str, firsts: dict[bytes, int] | None
    ) -> Row:
        key = row_key(self._spec, prompt, frames)
        with self._lock:
            for source in self._known:
                if (features := source.take(key)) is not None:
                    return KnownRow(row, key, features, source.environment_of(key))
            first = row if firsts is None else firsts.setdefault(key, row)
        if first != row:
            return RepeatedRow(row, key, first)
        recording = rows.recording
        variants = self._preparer.prepare_variants(recording.instruction, frames, key)
        return ReadyRow(row, key, variants, f"{recording.path}, VL row {row}")


def in_background(
    work: Iterable[Work],
    make: Callable[[Work], Made],
    threads: int,
    ahead: Callable[[], int] = lambda: 0,
) -> Generator[Made]:
    """`make` of each piece of work, in order, as many pieces before the reader as `ahead` says.

    At least `threads + 1`, so that no thread waits for the reader.
    """
    with ThreadPoolExecutor(threads, thread_name_prefix="decode") as pool:
        pieces: Iterator[Work] = iter(work)
        made: deque[Future[Made]] = deque()
        try:
            while True:
                lacking = max(threads + 1, ahead()) - len(made)  # below 0 once `ahead` has shrunk
                made.extend(pool.submit(make, piece) for piece in islice(pieces, max(0, lacking)))
                if not made:
                    return
                yield made.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)
