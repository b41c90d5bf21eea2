"""The rows of one LeRobot episode in a parquet file: where they are, their columns and clock.

LeRobot stores `timestamp` as float32, in which 0.1 is 0.10000000149. Where the stored times agree
with frame number / `fps`, the clock is computed from the numbers, without that rounding.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.base.border import shown
from pipeline.base.errors import RecordingError
from pipeline.data.jpeg import check_image, read_image
from pipeline.data.lerobot_meta import META, Entry, LeRobotMeta
from pipeline.data.media import RECORDINGS
from pipeline.data.parquet import ParquetTable
from pipeline.data.recording import CameraStream, check_clock, check_resolution, natural_key

CLOCK = "timestamp"
FRAME = "frame_index"
EPISODE = "episode_index"
_SAME_S = 1e-9
"""Largest difference of two float64 sums that count as the same time, in s."""
_ROUNDINGS = 2
"""Most steps of the stored type between a time and its frame number's time: the writer may have
multiplied by a rounded 1 / fps."""
_LATEST_S = 1e12
"""A clock in nanoseconds passes it after a quarter of an hour; one in seconds never does."""
_UNITS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}


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
        groups, offset = self.table.groups(self.start, self.stop)
        rows = self.table.numbers(wanted, groups).slice(self.start - offset, self.stop - self.start)
        if rows.num_columns and rows.num_rows != self.stop - self.start:
            why = f"expected {self.stop - self.start} rows as it declares, found {rows.num_rows}"
            raise RECORDINGS.refusal(self.path, why)
        return rows

    def images(self, column: str, rows: Sequence[int]) -> Iterator[tuple[int, bytes]]:
        """The encoded image of each of these rows (ascending, none twice), one row at a time."""
        groups, offset = self.table.groups(self.start, self.stop)
        where = f"{self.path}, column {column!r}"
        asked = set(rows)
        with self.table.open() as file:
            there, _ = self.table.check(file, [column], groups)
            kind = file.schema_arrow.field(column).type if there else pa.null()
            if not isinstance(kind, pa.StructType) or kind.get_field_index("bytes") < 0:
                raise RECORDINGS.refusal(where, f"expected images, found {shown(str(kind))}")
            # One row at a time: a large image, stored once, may be in every row.
            batches = file.iter_batches(1, row_groups=groups, columns=[f"{column}.bytes"])
            for row, batch in enumerate(batches, offset - self.start):
                if row not in asked:
                    continue
                image = batch.column(column).field("bytes")[0].as_py()
                if not isinstance(image, bytes):
                    where += f", row {self.start + row}"
                    raise RECORDINGS.refusal(where, "the cell has no image bytes")
                yield row, image
                asked.remove(row)
                if not asked:
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
        if captured is not None:  # one image may be in many rows, so times repeat
            check_resolution(time.astype(captured.dtype), where)
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


def find_rows(meta: LeRobotMeta, entry: Entry) -> ParquetRows:
    """The episode's rows, found by `episode_index`; the whole file if it has no such column.

    The metadata's file_index can be stale (lerobot up to 0.4.4), so if the named file has none of
    the rows, the other data files of v3.0 are searched. Raises `RecordingError` where the rows are
    not as many as `meta/` says (with both counts), or not together.
    """
    shared, named = meta.info.shared, meta.data(entry)
    others = sorted((meta.root / "data").glob("*/*.parquet"), key=natural_key) if shared else []
    for path in [named, *(other for other in others if other != named and other.is_file())]:
        table = ParquetTable(path, meta.limits)
        columns = table.numbers((EPISODE, CLOCK))
        if EPISODE in columns.column_names:
            index = matrix(columns[EPISODE], 1, f"{path}, {EPISODE!r}")[:, 0]
        elif shared:
            raise RECORDINGS.refusal(path, f"missing column {EPISODE!r}")
        else:
            index = np.full(columns.num_rows, float(entry.index))
        rows = np.flatnonzero(index == entry.index)
        if rows.size:
            of = f"rows of episode {entry.index}"
            if rows.size != entry.length:
                raise META.refusal(path, f"{rows.size} {of}, but meta/ says {entry.length}")
            if rows[-1] - rows[0] + 1 != rows.size:
                raise META.refusal(path, f"{of} are not together")
            return ParquetRows(table, int(rows[0]), int(rows[-1]) + 1)
    raise RecordingError(
        f"{named}: has no row of episode {entry.index}{', nor has any other file' * shared}. "
        "Give the data files their own names again, or copy the data set again"
    )


def matrix(column: pa.ChunkedArray, width: int, where: str) -> NDArray[np.float64]:
    """A column of vectors, or of numbers if the width is 1, as (row, width)."""
    array = column.combine_chunks()
    if array.null_count:
        raise RECORDINGS.refusal(where, f"no value in row {int(np.argmax(array.is_null()))}")
    if isinstance(array, pa.ListArray | pa.LargeListArray | pa.FixedSizeListArray):
        fixed = isinstance(array, pa.FixedSizeListArray)
        lengths = np.array([array.type.list_size]) if fixed else _numbers(array.value_lengths())
        if (lengths != width).any():
            row = int(np.argmax(lengths != width))
            why = f"{lengths[row]} values in row {row}, but its feature has {width}"
            raise RECORDINGS.refusal(where, why)
        array = array.flatten()
    values = _numbers(array)
    if values.size != len(column) * width:
        raise RECORDINGS.refusal(where, f"one number a row, but its feature has {width}")
    return values.astype(np.float64).reshape(len(column), width)


def _numbers(array: pa.Array) -> NDArray[Any]:
    """An array of numbers, NaN for a null; not with `to_numpy`, which would import pandas."""
    if array.null_count:
        array = array.cast(pa.float64()).fill_null(np.nan)
    dtype = np.dtype(array.type.to_pandas_dtype())
    return np.frombuffer(array.buffers()[1], dtype, len(array), array.offset * dtype.itemsize)


def read_clock(table: pa.Table, fps: float, where: str) -> NDArray[np.float64]:
    """(row,) s, rising; from frame numbers and `fps` if these agree with the stored times.

    Raises `RecordingError` where the clock does not rise or is not in seconds.
    """
    stored = stored_clock(table, where)
    check_clock(stored, f"{where}, {CLOCK!r}")
    check_resolution(stored.astype(_stored_type(table)), f"{where}, {CLOCK!r}")
    _check_seconds(stored, fps, where)
    time = _exact(stored, _stored_type(table), _frames(table, where), fps)
    # Rows are chosen by time: of two rows at one time, the earlier would get the later's frame.
    check_clock(time, f"{where}, {CLOCK!r}", rising=True)
    return time


def stored_clock(table: pa.Table, where: str) -> NDArray[np.float64]:
    """(row,) s, the column `timestamp` as stored."""
    if CLOCK not in table.column_names:
        raise RECORDINGS.refusal(where, f"missing column {CLOCK!r}")
    where += f", {CLOCK!r}"
    stored = matrix(table[CLOCK], 1, where)[:, 0]
    if (far := np.flatnonzero(np.abs(stored) > _LATEST_S)).size:
        why = f"expected seconds, found {stored[far[0]]:g} in row {far[0]}"
        raise RECORDINGS.refusal(where, why)
    return stored


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


def _check_seconds(time: NDArray[np.float64], fps: float, where: str) -> None:
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    for unit, factor in _UNITS.items():
        if 0.5 < step * fps / factor < 2:
            raise RecordingError(
                f"{where}, {CLOCK!r}: expected rows {1 / fps:.3g} s apart by fps {fps:g} of "
                f"meta/info.json, found {step:g}: these are {unit}. Divide the column by "
                f"{factor:g}, or correct fps"
            )
