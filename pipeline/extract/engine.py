"""The one engine: rows are prepared, encoded and written in any process, and marked in one.

Row ranges become rows ready for the model, decoded and prepared in the background. A `RowEngine`
has the model of a process: that of the coordinator, or each dask worker's. What was written counts
once the coordinator has marked it. `fill` is the coordinator's side.
"""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import chain, groupby, islice
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.digests import ContentDigests
from pipeline.data.row_range import Frames, RowFrames, RowRange, by_episode
from pipeline.extract.plan import rate_name
from pipeline.extract.survey import Survey
from pipeline.store import FEATURES, RowSource, StoreBuild
from pipeline.vlm.feature_spec import FeatureSpec
from pipeline.vlm.preparation import PreparedRow, Preparer

if TYPE_CHECKING:
    from pipeline.extract.encoder import Encoder


Work = TypeVar("Work")
Made = TypeVar("Made")

# Rows that one thread decodes in one go: long enough for video, short enough for memory.
#
# Variants count as rows of their own here: they wait in memory alike.
RANGE_ROWS = 16

# Blocks that are written or wait for it; the model waits when there are more: a kill loses few.
_WAITING = 2

# Known or repeated rows that are written in one go: each time waits for the disk.
_TOGETHER = 64


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
        key = self._spec.row_key(prompt, frames)
        with self._lock:
            for source in self._known:
                if (taken := source.take(key)) is not None:
                    return KnownRow(row, key, *taken)
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


@dataclass(frozen=True)
class ExtractionReport:
    """What was done; the shares are of the time since the model was loaded, where one was here.

    `taken` rows come from an earlier store or build, `repeated` ones equal another that was
    `computed`. The model worked `model_share` of the time and waited `waited_share` of it for
    frames to be decoded and prepared.
    """

    store: Path
    rows: int
    taken: int
    computed: int
    repeated: int
    seconds: float
    model_share: float | None
    waited_share: float | None


@dataclass(frozen=True)
class WrittenRows:
    """Feature rows that lie in the build and only need marking."""

    origin: Literal["computed", "known", "repeated"]
    rows: NDArray[np.int64]
    keys: Sequence[bytes]
    checksums: NDArray[np.uint32]
    environment: Mapping[str, Any]


@dataclass(frozen=True)
class FeatureBlock:
    """Rows of one environment with their features (row, variant x slot, dim), as they are stored.

    Repeated rows have None in place of features: theirs are those of their firsts.
    """

    origin: Literal["computed", "known", "repeated"]
    rows: Sequence[Row]
    features: NDArray[Any] | None
    environment: Mapping[str, Any]

    def write(self, build: StoreBuild) -> WrittenRows:
        """Write the features and wait for the disk."""
        features = self.features
        if features is None:
            firsts = [row.first for row in self.rows if isinstance(row, RepeatedRow)]
            files = build.files(FEATURES)
            features = np.concatenate([files.read(first, 1) for first in firsts])
        rows, keys = np.array([row.row for row in self.rows]), [row.key for row in self.rows]
        checksums = build.write_features(rows, features)
        return WrittenRows(self.origin, rows, keys, checksums, self.environment)


class RowMarks:
    """Marks written rows in the build, counts them by origin and moves the progress bar."""

    def __init__(self, build: StoreBuild, bar: "tqdm[Any]") -> None:
        self.build = build
        self.counts: Counter[str] = Counter()
        self._bar = bar

    def mark(self, written: Iterable[WrittenRows]) -> None:
        """Rows of one environment in one go: each time waits for the disk."""
        for environment, alike in groupby(written, attrgetter("environment")):
            blocks = list(alike)
            rows = np.concatenate([block.rows for block in blocks])
            keys = [key for block in blocks for key in block.keys]
            checksums = np.concatenate([block.checksums for block in blocks])
            self.build.mark(rows, keys, checksums, self.build.environment_index(environment))
            self._bar.update(len(rows))
            for block in blocks:
                self.counts[block.origin] += len(block.rows)


class RowEngine:
    """The preparation and the model of one process, which is loaded when a row first needs it.

    `loaded_at` is `time.monotonic()` then, `waited_s` how long the model has waited for rows.
    """

    def __init__(
        self, surveyed: Survey, frames: RowFrames, known: Sequence[RowSource], device: str
    ) -> None:
        self._vlm, self._extract = surveyed.params.vlm, surveyed.params.extract
        self.frames = frames
        self.encoder: Encoder | None = None
        self.loaded_at = self.waited_s = 0.0
        self._spec, self.variants = surveyed.spec, surveyed.spec.variants
        self._device = device
        self.preparation = RowPreparation(Preparer(self._vlm, self._spec), self._spec, known)
        self._environment: Mapping[str, Any] = {}

    def encode(self, prepared: Iterator[list[Row]], put: Callable[[FeatureBlock], object]) -> None:
        """Hand over the features of all these rows, a repeated row's after those of its first."""
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

    def _rows_for_model(
        self,
        prepared: Iterator[list[Row]],
        repeated: list[RepeatedRow],
        put: Callable[[FeatureBlock], object],
    ) -> Iterator[ReadyRow]:
        """Those that are ready; repeated ones are set aside, known ones handed over."""
        while True:
            begun = time.monotonic()
            rows = next(prepared, None)
            if self.encoder is not None:
                self.waited_s += time.monotonic() - begun
            if rows is None:
                return
            for block in _known_blocks([row for row in rows if isinstance(row, KnownRow)]):
                put(block)
            repeated += [row for row in rows if isinstance(row, RepeatedRow)]
            yield from (row for row in rows if isinstance(row, ReadyRow))

    def _loaded(self) -> "Encoder":
        if self.encoder is None:
            # Seconds to import: a run that finds every row in an older store does without.
            from pipeline.extract.encoder import Encoder
            from pipeline.vlm.qwen import FrozenVLM

            vlm = FrozenVLM.load(self._vlm, self._spec, self._device, self._extract.compile)
            self._environment = vlm.environment
            self.encoder = Encoder(vlm, self._extract.batch_size, self.variants)
            self.loaded_at = time.monotonic()
        return self.encoder


def row_frames(build: StoreBuild, surveyed: Survey) -> RowFrames:
    """The frames of a laid-out build's rows, by the times in it: no stream is read again."""
    vl_start, frame_time = (
        build.files(name).read(0, build.specs[name].shape[0])
        for name in ("episode/vl_start", "vl/frame_time")
    )
    return RowFrames(surveyed.recordings, vl_start, frame_time, surveyed.spec.views)


def fill(
    build: StoreBuild,
    surveyed: Survey,
    known: Sequence[RowSource],
    digests: ContentDigests,
    missing: NDArray[np.int64],
) -> ExtractionReport:
    """Fill in the missing rows of a laid-out build: of `known` where they are, else by the model.

    `extract.workers` says whether this process has the model, or dask workers do. Raises as they
    do; what was marked until then is kept.
    """
    begun, total = time.monotonic(), build.specs["vl/time"].shape[0]
    frames, extract = row_frames(build, surveyed), surveyed.params.extract
    done = total - len(missing)
    with tqdm(None, "extract", total, initial=done, unit="row", disable=None) as bar:
        marks = RowMarks(build, bar)
        taken: list[int] = []
        rows_known = _known_rows(surveyed, known, frames, missing)
        while rows := list(islice(rows_known, _TOGETHER)):
            marks.mark(block.write(build) for block in _known_blocks(rows))
            taken += [row.row for row in rows]
        missing = np.setdiff1d(missing, taken)
        rate = model_share = waited_share = None
        if len(missing) and extract.workers != 0:
            from pipeline.extract.cluster import compute_on_cluster  # dask: a second to import

            places = [source.path for source in known]
            rate = compute_on_cluster(surveyed, places, frames.vl_start, missing, marks)
        elif len(missing):
            engine = RowEngine(surveyed, frames, known, extract.device)
            compute_here(engine, missing, marks, extract.decode_threads)
            if engine.encoder is not None:
                since = time.monotonic() - engine.loaded_at
                rate = marks.counts["computed"] / since
                model_share, waited_share = engine.encoder.model_s / since, engine.waited_s / since
    if rate is not None:
        digests.note_rate(rate_name(surveyed), rate)
    of, seconds = marks.counts, time.monotonic() - begun
    counts = of["known"], of["computed"], of["repeated"]
    return ExtractionReport(build.target, total, *counts, seconds, model_share, waited_share)


def _known_rows(
    surveyed: Survey, known: Sequence[RowSource], frames: RowFrames, missing: NDArray[np.int64]
) -> Iterator[KnownRow]:
    """The missing rows that are known by content, instruction and frame times; decodes none."""
    for index, rows in by_episode(missing, frames.vl_start):
        episode = surveyed.episodes[index]
        of = episode.content, episode.recording.instruction
        keys = [(source, source.keys_of(*of)) for source in known]
        for row in rows.tolist():
            for source, by_frames in keys:
                key = by_frames.get(frames.frame_time[row].tobytes())
                if key is not None and (taken := source.take(key)) is not None:
                    yield KnownRow(row, key, *taken)
                    break


def _known_blocks(rows: Sequence[KnownRow]) -> Iterator[FeatureBlock]:
    for environment, alike in groupby(rows, attrgetter("environment")):
        block = list(alike)
        features = np.stack([row.features for row in block])
        yield FeatureBlock("known", block, features, environment)


def compute_here(
    engine: RowEngine, missing: NDArray[np.int64], marks: RowMarks, threads: int
) -> None:
    """Compute and mark rows in this process: threads prepare, this one encodes, one commits."""

    def ranges_ahead() -> int:
        """While the model has one batch, the next should be complete."""
        return 2 * engine.encoder.size.current // RANGE_ROWS + 1 if engine.encoder else 0

    most = max(1, RANGE_ROWS // engine.variants)
    rows = in_background(
        engine.frames.ranges(missing, most),
        partial(engine.preparation.prepare, firsts={}),
        threads,
        ranges_ahead,
    )
    with _committing(marks) as put, closing(rows):
        engine.encode(rows, put)


@contextmanager
def _committing(marks: RowMarks) -> Generator[Callable[[FeatureBlock], None]]:
    """Give what writes and marks blocks in order, on a thread, while the model goes on.

    What fails there is raised by a later call. Leaving the context waits for what was handed in,
    whatever else went wrong: it is computed.
    """
    pending: deque[Future[None]] = deque()

    def commit(block: FeatureBlock, before: Future[None] | None) -> None:
        if before is not None:
            before.result()  # after a failure nothing: a repeated row is copied from one before
        marks.mark([block.write(marks.build)])

    def put(block: FeatureBlock) -> None:
        while len(pending) >= _WAITING:
            pending.popleft().result()
        pending.append(pool.submit(commit, block, pending[-1] if pending else None))

    with ThreadPoolExecutor(1, thread_name_prefix="commit") as pool:
        yield put
        for commits in pending:
            commits.result()
