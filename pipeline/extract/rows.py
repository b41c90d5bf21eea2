"""VL rows on their way into a build: read, known or made ready for the model, written, marked.

Any process may write features, but only the coordinating one marks them, and only marked rows
count.
"""

import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.provenance import spread
from pipeline.data.episode import Frames, RowFrames, RowRange
from pipeline.extract.build_state import Say
from pipeline.extract.survey import Survey
from pipeline.store import FEATURES, GoldenFrames, RowSource, StoreBuild
from pipeline.store.golden_rows import carried_golden
from pipeline.store.schema import KEYS
from pipeline.vlm.preparation import PreparedRow, Preparer


@dataclass(frozen=True)
class KnownRow:
    """A row that an older store or build has."""

    row: int
    key: bytes
    features: NDArray[Any]
    environment: dict[str, Any]


@dataclass(frozen=True)
class ReadyRow:
    """A row ready for the model: variant 0 with plain frames, then augmented; all of one shape.

    `where` names the recording and the row, for messages.
    """

    row: int
    key: bytes
    variants: tuple[PreparedRow, ...]
    where: str


@dataclass(frozen=True)
class RepeatedRow:
    """A row with the same frames and prompt as `first`; the model runs only on `first`."""

    row: int
    key: bytes
    first: int


Row = KnownRow | ReadyRow | RepeatedRow


class RowPreparation:
    """Turns row ranges into rows; several threads may use it."""

    def __init__(self, surveyed: Survey, known: Sequence[RowSource]) -> None:
        """Rows whose key is in `known` are taken from there."""
        self._preparer = Preparer(surveyed.vlm, surveyed.spec)
        self._spec = surveyed.spec
        self._known = known
        self._lock = threading.Lock()

    def prepare(self, rows: RowRange, firsts: dict[bytes, int] | None = None) -> list[Row]:
        """The rows of a range; each decoded frame is kept only while its row is made.

        `firsts` keeps the first row of each key, and only that row is made ready; without `firsts`,
        all rows are. Raises what the recording raises.
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


@dataclass(frozen=True)
class WrittenRows:
    """Feature rows that are written in the build but not marked yet."""

    origin: Literal["computed", "known", "repeated"]
    rows: NDArray[np.int64]
    keys: Sequence[bytes]
    checksums: NDArray[np.uint32]
    environment: Mapping[str, Any]


@dataclass(frozen=True)
class FeatureBlock:
    """Rows of one environment with their features (row, variant x slot, dim), as stored.

    The features of repeated rows are None: `write` reads them from their first rows.
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


def known_blocks(rows: Sequence[KnownRow]) -> Iterator[FeatureBlock]:
    """Consecutive known rows of one environment as blocks."""
    for environment, group in groupby(rows, attrgetter("environment")):
        block = list(group)
        features = np.stack([row.features for row in block])
        yield FeatureBlock("known", block, features, environment)


class RowMarks:
    """Marks written rows in the build, counts them by origin and moves the progress bar."""

    def __init__(self, build: StoreBuild, bar: "tqdm[Any]") -> None:
        self.build = build
        self.counts: Counter[str] = Counter()
        self._bar = bar

    def mark(self, written: Iterable[WrittenRows]) -> None:
        """Mark rows, grouped by environment because each mark waits for the disk."""
        for environment, group in groupby(written, attrgetter("environment")):
            blocks = list(group)
            rows = np.concatenate([block.rows for block in blocks])
            keys = [key for block in blocks for key in block.keys]
            checksums = np.concatenate([block.checksums for block in blocks])
            self.build.mark(rows, keys, checksums, self.build.environment_index(environment))
            self._bar.update(len(rows))
            for block in blocks:
                self.counts[block.origin] += len(block.rows)


def row_frames(build: StoreBuild, surveyed: Survey) -> RowFrames:
    """The frames of a laid-out build's rows, found by its stored times; reads no stream."""
    vl_start, frame_time = (
        build.files(name).read(0, build.specs[name].shape[0])
        for name in ("episode/vl_start", "vl/frame_time")
    )
    return RowFrames(surveyed.recordings, vl_start, frame_time, surveyed.spec.views)


def keep_golden(build: StoreBuild, surveyed: Survey, stores: Sequence[Path], say: Say) -> None:
    """Write the golden rows of a build that has all its rows: at most four, evenly spread.

    Rows that one of `stores` has are copied from it, the others are decoded. A row is left out,
    and `say` prints that, if its frames now decode to other pixels than when it was computed.
    Raises `RecordingError` where a recording is gone, and `DiskFull`.
    """
    frames = row_frames(build, surveyed)
    views = np.isfinite(frames.frame_time).sum(axis=1)
    chosen = spread(np.arange(len(views)), views)
    carried = _carried(build, surveyed, stores)
    taken = [carried.pop(row) for row in chosen.tolist() if row in carried]
    wanted = np.setdiff1d(chosen, [golden.row for golden in taken])
    if left_out := build.write_golden([*taken, *_decoded(frames, wanted, surveyed)]):
        say(
            f"{left_out} golden row(s) left out: decoded today, their frames are other pixels than "
            "those that the stored features were computed from (stages.verify --reextract tells "
            "how far the features are apart)"
        )


def _carried(
    build: StoreBuild, surveyed: Survey, stores: Sequence[Path]
) -> dict[int, GoldenFrames]:
    """The golden frames of these stores, by row.

    A store under repair counts too: damaged frames do not give their key and are left out.
    """
    keys = build.files(KEYS).read(0, build.specs[KEYS].shape[0])
    carried: dict[int, GoldenFrames] = {}
    for store in stores:
        for golden in carried_golden(store, surveyed.spec.attrs(), keys):
            carried.setdefault(golden.row, golden)
    return carried


def _decoded(
    frames: RowFrames, rows: NDArray[np.int64], surveyed: Survey
) -> Iterator[GoldenFrames]:
    preparer = Preparer(surveyed.vlm, surveyed.spec)
    for part in frames.ranges(rows):
        prompt = preparer.render(part.recording.instruction, list(part.frames))
        for row, decoded in part.read():
            yield GoldenFrames(row, prompt, decoded)
