"""Rows of parquet files whose declared sizes are within limits: columns, images and clock.

LeRobot stores `timestamp` as float32, in which 0.1 is 0.10000000149. Where the stored times agree
with frame number / `fps`, the clock is computed from the numbers, without that rounding.
"""

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from pipeline.base.config import MediaLimits
from pipeline.base.documents import shown
from pipeline.base.errors import RecordingError
from pipeline.data.arrays import matrix
from pipeline.data.jpeg import check_image, read_image
from pipeline.data.recording import (
    RECORDINGS,
    CameraStream,
    check_clock,
    check_resolution,
    check_unpacked,
)

CLOCK = "timestamp"
FRAME = "frame_index"
EPISODE = "episode_index"
_SAME_S = 1e-9
"""Largest difference of two float64 sums that count as the same time, in s."""
_ROUNDINGS = 2
"""Most steps of the stored type between a time and its frame number's time: the writer may have
multiplied by a rounded 1 / fps."""
_WIDEST = 8
"""Most bytes of one number, or of the offset of a text."""
_BATCH_BYTES = 64 * 2**20
_BATCH_ROWS = 1024


@dataclass(frozen=True)
class ParquetTable:
    """A parquet file; its methods raise `RecordingError`, which names it, for every fault."""

    path: Path
    limits: MediaLimits

    @contextmanager
    def open(self) -> Generator[pq.ParquetFile, None, None]:
        """The open file; an error inside becomes a `RecordingError`."""
        RECORDINGS.check_file(self.path)
        unreadable = RECORDINGS.foreign(self.path, "cannot be read as parquet")
        with unreadable, pq.ParquetFile(self.path) as file:
            yield file

    def check(
        self, file: pq.ParquetFile, wanted: Sequence[str], groups: Sequence[int]
    ) -> tuple[list[str], int]:
        """Those wanted columns that the file has, and the most bytes that a cell can have.

        Refuses a repeated column, and more bytes in these row groups than the limits allow; reads
        no data.
        """
        names = file.schema_arrow.names
        present = [name for name in wanted if name in names]
        if twice := [name for name in present if names.count(name) > 1]:
            raise RECORDINGS.refusal(self.path, f"expected one column {twice[0]!r}, found more")
        # Arrow reads all leaves whose path begins with the column's name.
        begins = tuple(f"{name}." for name in present)
        schema = file.schema
        paths = [schema.column(place).path for place in range(len(schema))]
        leaves = [place for place, path in enumerate(paths) if f"{path}.".startswith(begins)]
        pages = unpacked = 0
        for rows in map(file.metadata.row_group, groups):
            for leaf in map(rows.column, leaves):
                pages += max(0, leaf.total_uncompressed_size)
                unpacked += max(0, leaf.total_uncompressed_size, leaf.num_values * _WIDEST)
        check_unpacked(self.path, unpacked, self.limits)
        return present, pages

    def rows(self, wanted: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
        """The place of each row (for messages) and its cells in those wanted columns that exist."""
        with self.open() as file:
            present, largest = self.check(file, wanted, range(file.num_row_groups))
            # A text stored once may be in every row.
            rows = min(_BATCH_ROWS, _BATCH_BYTES // max(1, largest) + 1)
            number = 0
            for batch in file.iter_batches(rows, columns=present, use_threads=False):
                for row in batch.to_pylist():
                    yield f"{self.path}, row {number}", row
                    number += 1

    def numbers(self, wanted: Sequence[str]) -> pa.Table:
        """Those wanted columns that the file has, with numbers or lists of numbers."""
        RECORDINGS.check_file(self.path)
        return _read_numbers(self, self.path.stat().st_mtime_ns, tuple(wanted))


# Cached, because hundreds of episodes, read in order, can share a file.
@lru_cache(maxsize=4)
def _read_numbers(table: ParquetTable, changed_ns: int, wanted: tuple[str, ...]) -> pa.Table:
    with table.open() as file:
        present, _ = table.check(file, wanted, range(file.num_row_groups))
        schema = file.schema_arrow
        for name in present:
            kind = number = schema.field(name).type
            if isinstance(kind, pa.ListType | pa.LargeListType | pa.FixedSizeListType):
                number = kind.value_type
            if not (pa.types.is_floating(number) or pa.types.is_integer(number)):
                where = f"{table.path}, column {name!r}"
                raise RECORDINGS.refusal(where, f"expected numbers, found {shown(str(kind))}")
        return file.read(columns=present)


@dataclass(frozen=True)
class ParquetRows:
    """A half-open range of rows of a parquet file."""

    table: ParquetTable
    start: int
    stop: int

    @property
    def path(self) -> Path:
        """The file."""
        return self.table.path

    def columns(self, wanted: Sequence[str]) -> pa.Table:
        """Those wanted columns that the file has, each (row,), with numbers or lists of numbers."""
        return self.table.numbers(wanted).slice(self.start, self.stop - self.start)

    def images(self, column: str, rows: Sequence[int]) -> Iterator[tuple[int, bytes]]:
        """The encoded image of each of these rows (ascending, none twice), one row at a time."""
        where = f"{self.path}, column {column!r}"
        missing = set(rows)
        with self.table.open() as file:
            places = range(file.num_row_groups)
            counts = np.array([file.metadata.row_group(place).num_rows for place in places])
            ends = np.cumsum(counts)
            first = int(np.searchsorted(ends, self.start, side="right"))
            groups = places[first : int(np.searchsorted(ends, self.stop)) + 1]
            offset = int(ends[first] - counts[first])
            present, _ = self.table.check(file, [column], groups)
            kind = file.schema_arrow.field(column).type if present else pa.null()
            if not isinstance(kind, pa.StructType) or kind.get_field_index("bytes") < 0:
                raise RECORDINGS.refusal(where, f"expected images, found {shown(str(kind))}")
            # One row at a time: a large image, stored once, may be in every row.
            batches = file.iter_batches(1, row_groups=groups, columns=[f"{column}.bytes"])
            for row, batch in enumerate(batches, offset - self.start):
                if row not in missing:
                    continue
                image = batch.column(column).field("bytes")[0].as_py()
                if not isinstance(image, bytes):
                    where += f", row {self.start + row}"
                    raise RECORDINGS.refusal(where, "the cell has no image bytes")
                yield row, image
                missing.remove(row)
                if not missing:
                    return
        raise RECORDINGS.refusal(where, f"expected {self.stop - self.start} rows, found less")


class ParquetCamera(CameraStream):
    """A view whose frames are encoded images in the rows."""

    def __init__(
        self,
        view: str,
        time: NDArray[np.float64],
        rows: ParquetRows,
        column: str,
        captured: NDArray[np.float64] | None = None,
    ) -> None:
        """`time` and `captured` (row,) s: when rows were recorded, and when images were captured.

        Without `captured`, each row has its own frame at its own time. With `captured`, rows with
        the same capture time share one frame, which is shown until the next. Raises
        `RecordingError` where the number of capture times is not that of the rows, or where they
        decrease or are later than their rows.
        """
        self.view = view
        self._rows = rows
        self._column = column
        self._clock = time
        own = time if captured is None else np.asarray(captured, np.float64)
        if own.shape != time.shape:
            raise RecordingError(
                f"{rows.path}: {len(time)} rows, but times {own.shape} of the images of {view!r} "
                "in the sidecar frames/: they must agree"
            )
        where = f"{rows.path}, the times of the images of {view!r}"
        check_clock(own, where)
        if (late := np.flatnonzero(own > time + _SAME_S)).size:
            row = int(late[0])
            raise RecordingError(
                f"{rows.path}: the image of {view!r} in row {row} was captured at {own[row]:.6f} s "
                f"by the sidecar frames/, after its row at {time[row]:.6f} s: mend its times"
            )
        self._row = np.flatnonzero(np.diff(own, prepend=-np.inf))
        self.time = own[self._row]

    @property
    def covered(self) -> NDArray[np.float64]:
        return self._clock

    def check(self, indices: Sequence[int]) -> None:
        for row, image in self._rows.images(self._column, self._rows_of(sorted(set(indices)))):
            check_image(image, self._where(row), self._rows.table.limits)

    def read(self, indices: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
        wanted = self._rows_of(indices)
        place = 0
        for row, image in self._rows.images(self._column, sorted(set(wanted))):
            frame = read_image(image, self._where(row), self._rows.table.limits)
            while place < len(wanted) and wanted[place] == row:
                yield frame
                place += 1

    def _rows_of(self, indices: Sequence[int]) -> list[int]:
        return self._row[np.asarray(indices, np.int64)].tolist()

    def _where(self, row: int) -> str:
        return f"{self._rows.path}, column {self._column!r}, row {self._rows.start + row}"


def read_clock(table: pa.Table, fps: float, where: str) -> NDArray[np.float64]:
    """(row,) s, rising; from frame numbers and `fps` if these agree with the stored times.

    Raises `RecordingError` where the clock does not rise.
    """
    stored = stored_clock(table, where)
    check_clock(stored, f"{where}, {CLOCK!r}")
    check_resolution(stored.astype(_stored_type(table)), f"{where}, {CLOCK!r}")
    time = _exact(stored, _stored_type(table), _frames(table, where), fps)
    # Rows are chosen by time: of two rows at one time, the earlier would get the later's frame.
    check_clock(time, f"{where}, {CLOCK!r}", rising=True)
    return time


def stored_clock(table: pa.Table, where: str) -> NDArray[np.float64]:
    """(row,) s, the column `timestamp` as stored."""
    if CLOCK not in table.column_names:
        raise RECORDINGS.refusal(where, f"missing column {CLOCK!r}")
    return matrix(table[CLOCK], 1, f"{where}, {CLOCK!r}")[:, 0]


def check_frames(table: pa.Table, rows: ParquetRows) -> None:
    """Raise `RecordingError` where frame numbers do not rise.

    They may begin above 0 and have gaps, because rows may have been removed.
    """
    frame = _frames(table, str(rows.path))
    if (fallen := np.flatnonzero(~(np.diff(frame) > 0))).size:
        row = int(fallen[0]) + 1
        raise RecordingError(
            f"{rows.path}, row {rows.start + row}: expected {FRAME} above {frame[row - 1]:g}, "
            f"found {frame[row]:g}: rows are out of order or there twice. Sort them, or copy the "
            "data set again"
        )


def _frames(table: pa.Table, where: str) -> NDArray[np.float64]:
    """(row,) the frame numbers; the row numbers where the column is absent."""
    if FRAME not in table.column_names:
        return np.arange(table.num_rows, dtype=np.float64)
    return matrix(table[FRAME], 1, f"{where}, {FRAME!r}")[:, 0]


def _stored_type(table: pa.Table) -> "np.dtype[Any]":
    """The type of the column `timestamp`; float64 for whole numbers."""
    kind = table.schema.field(CLOCK).type
    kind = getattr(kind, "value_type", kind)
    return np.dtype(kind.to_pandas_dtype() if pa.types.is_floating(kind) else np.float64)


def _exact(
    stored: NDArray[np.float64], dtype: "np.dtype[Any]", frame: NDArray[np.float64], fps: float
) -> NDArray[np.float64]:
    """`offset + frame / fps` if all stored times differ from it only by the rounding of `dtype`.

    The offset is a whole number of frames, or the shortest decimal that rounds to the first time.
    Otherwise, and for float64, the stored times are returned.
    """
    if dtype == np.float64:
        return stored
    since = frame - frame[0]
    first = dtype.type(stored[0])
    largest = np.maximum(np.abs(stored), np.abs(stored[0])).astype(dtype)
    allowed = _ROUNDINGS * np.spacing(largest).astype(np.float64)
    for time in ((np.rint(stored[0] * fps) + since) / fps, float(str(first)) + since / fps):
        if (np.abs(time - stored) <= allowed).all():
            return time
    return stored
