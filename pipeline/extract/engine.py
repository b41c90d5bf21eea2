"""Fill the missing rows of a build: from older stores if they have them, else with the model.

`fill` is the coordinator's side. An executor computes the rows that no older store has:
`compute_here` in this process, `pipeline.extract.dask_cluster` on dask workers. In both cases a
`RowEngine` holds the model of a process.
"""

import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.digests import ContentDigests
from pipeline.data.episode import RowFrames, by_episode
from pipeline.extract.rows import (
    FeatureBlock,
    KnownRow,
    ReadyRow,
    RepeatedRow,
    Row,
    RowMarks,
    RowPreparation,
    known_blocks,
    row_frames,
)
from pipeline.extract.survey import Survey
from pipeline.store import RowSource, StoreBuild

if TYPE_CHECKING:
    from pipeline.extract.encoder import Encoder


Work = TypeVar("Work")
Made = TypeVar("Made")

# Rows that one thread decodes at a time: enough for video, few enough for memory. Each variant
# counts as a row, because it takes as much memory.
RANGE_ROWS = 16

# Most blocks that are being written or wait. The model waits when there are more, so that a kill
# loses few rows.
_WAITING = 2

# Known or repeated rows per write: each write waits for the disk.
_TOGETHER = 64


class Speed(NamedTuple):
    """How fast rows were computed; the shares are of the time since the model was loaded.

    The model worked for `model_share` of that time and waited for `waited_share` of it until frames
    were decoded and prepared. None where it was not measured.
    """

    rows_per_s: float | None = None
    model_share: float | None = None
    waited_share: float | None = None


Executor = Callable[
    [Survey, Sequence[RowSource], RowFrames, NDArray[np.int64], RowMarks],
    Speed,
]
"""Computes and marks the missing rows (ascending) of a build; known rows come from the sources."""


@dataclass(frozen=True)
class ExtractionReport:
    """What was done: `taken` rows come from an earlier store or build, `repeated` rows equal a
    `computed` row."""

    rows: int
    taken: int
    computed: int
    repeated: int
    seconds: float
    speed: Speed

    def lines(self) -> list[str]:
        """The report in lines for people."""
        rate = self.computed / self.seconds if self.seconds else 0.0
        lines = [
            f"{self.rows} rows, {self.computed} computed ({rate:.1f} rows/s), {self.taken} taken "
            f"over, {self.repeated} equal to another"
        ]
        if self.speed.model_share is not None and self.speed.waited_share is not None:
            lines.append(
                f"the model worked {self.speed.model_share:.0%} of the time and waited "
                f"{self.speed.waited_share:.0%} for frames"
            )
        return lines


def fill(
    build: StoreBuild,
    surveyed: Survey,
    known: Sequence[RowSource],
    digests: ContentDigests,
    missing: NDArray[np.int64],
    executor: Executor,
) -> ExtractionReport:
    """Fill in the missing rows of a laid-out build.

    Raises what the executor raises; rows marked before are kept.
    """
    begun, total = time.monotonic(), build.specs["vl/time"].shape[0]
    frames, done = row_frames(build, surveyed), total - len(missing)
    with tqdm(None, "extract", total, initial=done, unit="row", disable=None) as bar:
        marks = RowMarks(build, bar)
        taken: list[int] = []
        rows_known = _known_rows(surveyed, known, frames, missing)
        while rows := list(islice(rows_known, _TOGETHER)):
            marks.mark(block.write(build) for block in known_blocks(rows))
            taken += [row.row for row in rows]
        missing = np.setdiff1d(missing, taken)
        speed = executor(surveyed, known, frames, missing, marks) if len(missing) else Speed()
    if speed.rows_per_s is not None:
        digests.note_rate(surveyed.rate_name, speed.rows_per_s)
    return ExtractionReport(
        rows=total,
        taken=marks.counts["known"],
        computed=marks.counts["computed"],
        repeated=marks.counts["repeated"],
        seconds=time.monotonic() - begun,
        speed=speed,
    )


def _known_rows(
    surveyed: Survey, known: Sequence[RowSource], frames: RowFrames, missing: NDArray[np.int64]
) -> Iterator[KnownRow]:
    """The missing rows known by content, instruction and frame times; decodes no frame."""
    for index, rows in by_episode(missing, frames.vl_start):
        episode = surveyed.episodes[index]
        identity = episode.content, episode.recording.instruction
        keys = [(source, source.keys_of(*identity)) for source in known]
        for row in rows.tolist():
            for source, by_frames in keys:
                key = by_frames.get(frames.frame_time[row].tobytes())
                if key is not None and (taken := source.take(key)) is not None:
                    yield KnownRow(row, key, *taken)
                    break


class RowEngine:
    """The preparation and the model of one process; the model is loaded when a row needs it."""

    def __init__(
        self, surveyed: Survey, frames: RowFrames, known: Sequence[RowSource], device: str
    ) -> None:
        self._surveyed, self._device = surveyed, device
        self.frames = frames
        self.preparation = RowPreparation(surveyed, known)
        self.encoder: Encoder | None = None
        self._environment: Mapping[str, Any] = {}
        self._loaded_at = self._waited_s = 0.0

    def encode(self, prepared: Iterator[list[Row]], put: Callable[[FeatureBlock], object]) -> None:
        """Pass the features of all rows to `put`, those of a repeated row after its first row."""
        repeated: list[RepeatedRow] = []
        done: set[int] = set()

        def put_repeated() -> None:
            ready = [row for row in repeated if row.first in done]
            repeated[:] = [row for row in repeated if row.first not in done]
            if ready:
                put(FeatureBlock("repeated", ready, None, self._environment))

        rows = self._rows_for_model(prepared, repeated, put)
        if (first := next(rows, None)) is not None:
            for batch, features in self._loaded().encoded(chain([first], rows)):
                put(FeatureBlock("computed", batch, features, self._environment))
                done |= {row.row for row in batch}
                if len(repeated) >= _TOGETHER:
                    put_repeated()
        put_repeated()
        assert not repeated, "a repeated row whose first was never computed"

    def speed(self, computed: int) -> Speed:
        """The speed since the model was loaded, in which it computed this many rows."""
        if self.encoder is None:
            return Speed()
        since = time.monotonic() - self._loaded_at
        return Speed(computed / since, self.encoder.model_s / since, self._waited_s / since)

    def _rows_for_model(
        self,
        prepared: Iterator[list[Row]],
        repeated: list[RepeatedRow],
        put: Callable[[FeatureBlock], object],
    ) -> Iterator[ReadyRow]:
        """The ready rows; repeated rows go to `repeated`, known rows to `put`."""
        while True:
            begun = time.monotonic()
            rows = next(prepared, None)
            if self.encoder is not None:
                self._waited_s += time.monotonic() - begun
            if rows is None:
                return
            for block in known_blocks([row for row in rows if isinstance(row, KnownRow)]):
                put(block)
            repeated += [row for row in rows if isinstance(row, RepeatedRow)]
            yield from (row for row in rows if isinstance(row, ReadyRow))

    def _loaded(self) -> "Encoder":
        if self.encoder is None:
            # The import takes seconds; a run that finds every row in an older store needs none.
            from pipeline.extract.encoder import Encoder
            from pipeline.vlm.qwen import FrozenVLM

            extract, spec = self._surveyed.extract, self._surveyed.spec
            vlm = FrozenVLM.load(self._surveyed.vlm, spec, self._device, extract.compile)
            self._environment = vlm.environment
            self.encoder = Encoder(vlm, extract.batch_size, spec.variants)
            self._loaded_at = time.monotonic()
        return self.encoder


def compute_here(
    surveyed: Survey,
    known: Sequence[RowSource],
    frames: RowFrames,
    missing: NDArray[np.int64],
    marks: RowMarks,
) -> Speed:
    """The executor of this process: threads prepare, the caller's encodes, another commits."""
    extract = surveyed.extract
    engine = RowEngine(surveyed, frames, known, extract.device)

    def ranges_ahead() -> int:
        """While the model works on one batch, the next should be complete."""
        return 2 * engine.encoder.size.current // RANGE_ROWS + 1 if engine.encoder else 0

    rows = in_background(
        frames.ranges(missing, max(1, RANGE_ROWS // surveyed.spec.variants)),
        partial(engine.preparation.prepare, firsts={}),
        extract.decode_threads,
        ranges_ahead,
    )
    with _committing(marks) as put, closing(rows):
        engine.encode(rows, put)
    return engine.speed(marks.counts["computed"])


def in_background(
    work: Iterable[Work],
    make: Callable[[Work], Made],
    threads: int,
    ahead: Callable[[], int] = lambda: 0,
) -> Generator[Made]:
    """`make(piece)` for each piece of work, in order, made by threads ahead of the reader.

    `ahead()` says how many pieces ahead; at least `threads + 1`, so that no thread waits for the
    reader.
    """
    with ThreadPoolExecutor(threads, thread_name_prefix="decode") as pool:
        pieces: Iterator[Work] = iter(work)
        made: deque[Future[Made]] = deque()
        try:
            while True:
                lacking = max(threads + 1, ahead()) - len(made)  # below 0 after `ahead` shrank
                made.extend(pool.submit(make, piece) for piece in islice(pieces, max(0, lacking)))
                if not made:
                    return
                yield made.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def _committing(marks: RowMarks) -> Generator[Callable[[FeatureBlock], None]]:
    """A function that writes and marks blocks in order, on a thread, while the model works.

    A later call raises what failed there. On exit, also after an error, the context waits for all
    blocks handed in, because they are computed.
    """
    pending: deque[Future[None]] = deque()

    def commit(block: FeatureBlock, before: Future[None] | None) -> None:
        if before is not None:
            before.result()  # raises after a failure: a repeated row is copied from an earlier one
        marks.mark([block.write(marks.build)])

    def put(block: FeatureBlock) -> None:
        while len(pending) >= _WAITING:
            pending.popleft().result()
        pending.append(pool.submit(commit, block, pending[-1] if pending else None))

    with ThreadPoolExecutor(1, thread_name_prefix="commit") as pool:
        yield put
        for commits in pending:
            commits.result()
