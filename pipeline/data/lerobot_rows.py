"""The rows of one LeRobot episode in a parquet file: where they are, and their columns."""

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from pipeline.base.errors import RecordingError
from pipeline.data.jpeg import check_image, read_image
from pipeline.data.lerobot_layout import LeRobotEntry, LeRobotLayout
from pipeline.data.reader import natural_key
from pipeline.data.recording import CameraStream, check_clock

_IMAGE_ROWS = 8
"""Rows of encoded images held at a time."""
_SAME_S = 1e-9
"""By which sums of steps in float64 may differ and be the same time."""


@dataclass(frozen=True)
class ParquetRows:
    """A half-open range of rows of a parquet file."""

    path: Path
    start: int
    stop: int

    def columns(self, wanted: Sequence[str]) -> pa.Table:
        """Those wanted columns that the file has, (row,) each."""
        groups, offset = self._groups()
        table = _read_groups(*_stamped(self.path), groups, tuple(wanted))
        return table.slice(self.start - offset, self.stop - self.start)

    def images(self, column: str, rows: Sequence[int]) -> Iterator[tuple[int, bytes]]:
        """The encoded image of each row asked for (ascending, no twins), a few rows at a time."""
        groups, offset = self._groups()
        pending = iter(rows)
        row = next(pending, None)
        with opened(self.path) as file:
            at = offset - self.start
            batches = file.iter_batches(_IMAGE_ROWS, row_groups=list(groups), columns=[column])
            for batch in batches:
                while row is not None and row < at + batch.num_rows:
                    yield row, _encoded(batch.column(0)[row - at].as_py(), self.path, column, row)
                    row = next(pending, None)
                at += batch.num_rows
                if row is None:
                    return

    def _groups(self) -> tuple[tuple[int, ...], int]:
        """The row groups that hold the range, and the file row at which the first begins."""
        with opened(self.path) as file:
            sizes = [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)]
        ends = np.cumsum(sizes, dtype=np.int64)
        first = int(np.searchsorted(ends, self.start, side="right"))
        last = int(np.searchsorted(ends, self.stop, side="left"))
        return tuple(range(first, last + 1)), int(ends[first] - sizes[first])


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
        """`time` and `captured` (row,) s: when rows were recorded, and their images captured.

        Without `captured`, each row has a frame of its own time. With it, rows whose images have
        one time show one frame, which stands until the next. Raises `RecordingError` where there
        are more or fewer of these times than rows, where they fall, or lie after their rows.
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
        check_clock(own, f"{rows.path}, the times of the images of {view!r}")
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
            check_image(image, self._where(row))

    def read(self, indices: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
        wanted = self._rows_of(indices)
        place = 0
        for row, image in self._rows.images(self._column, sorted(set(wanted))):
            frame = read_image(image, self._where(row))
            while place < len(wanted) and wanted[place] == row:
                yield frame
                place += 1

    def _rows_of(self, indices: Sequence[int]) -> list[int]:
        return self._row[np.asarray(indices, np.int64)].tolist()

    def _where(self, row: int) -> str:
        return f"{self._rows.path}, column {self._column!r}, row {self._rows.start + row}"


def find_rows(layout: LeRobotLayout, entry: LeRobotEntry) -> ParquetRows:
    """The episode's rows, found by their `episode_index` in a shared file.

    The metadata's file_index can be stale (lerobot up to 0.4.4), so where the file named has none
    of the rows, the other data files are searched. Raises `RecordingError` naming both counts
    where they are not as many as `meta/` says, or not together.
    """
    if not entry.shared:
        with opened(entry.data) as file:
            rows = ParquetRows(entry.data, 0, file.metadata.num_rows)
        _check_length(rows.stop, entry, entry.data)
        if not rows.stop:
            raise RecordingError(f"{entry.data}: has no row of episode {entry.index}")
        return rows
    others = sorted((layout.root / "data").glob("*/*.parquet"), key=natural_key)
    for path in [entry.data, *(other for other in others if other != entry.data)]:
        if not path.is_file():
            continue
        found = np.flatnonzero(_episode_column(*_stamped(path)) == entry.index)
        if found.size:
            _check_length(found.size, entry, path)
            if found[-1] - found[0] + 1 != found.size:
                raise RecordingError(f"{path}: rows of episode {entry.index} are not together")
            return ParquetRows(path, int(found[0]), int(found[-1]) + 1)
    raise RecordingError(
        f"{entry.data}: has no row of episode {entry.index}, nor has any other file under "
        f"{layout.root / 'data'}"
    )


def matrix(column: pa.ChunkedArray, width: int, where: str) -> NDArray[np.float64]:
    """A column of vectors, or of numbers where the width is 1, as (row, width)."""
    array = column.combine_chunks()
    if array.null_count:
        raise RecordingError(f"{where}: no value in row {int(np.argmax(array.is_null()))}")
    if isinstance(array, pa.ListArray | pa.LargeListArray | pa.FixedSizeListArray):
        fixed = isinstance(array, pa.FixedSizeListArray)
        lengths = np.asarray([array.type.list_size] if fixed else array.value_lengths())
        if (lengths != width).any():
            row = int(np.argmax(lengths != width))
            raise RecordingError(
                f"{where}: {lengths[row]} values in row {row}, but its feature has {width}"
            )
        array = array.flatten()
    if not (pa.types.is_floating(array.type) or pa.types.is_integer(array.type)):
        raise RecordingError(f"{where}: expected numbers, found {array.type}")
    values = array.to_numpy(zero_copy_only=False)
    if values.size != len(column) * width:
        raise RecordingError(f"{where}: one number a row, but its feature has {width}")
    return values.astype(np.float64).reshape(len(column), width)


@contextmanager
def opened(path: Path) -> Generator[pq.ParquetFile, None, None]:
    """An open parquet file; what goes wrong inside is a `RecordingError` that names it."""
    try:
        with pq.ParquetFile(path) as file:
            yield file
    except (pa.ArrowException, OSError) as error:
        raise RecordingError(
            f"{path}: cannot be read as parquet: {error}; copy the file again"
        ) from None


def _check_length(rows: int, entry: LeRobotEntry, path: Path) -> None:
    if rows != entry.length:
        raise RecordingError(
            f"{path}: {rows} rows of episode {entry.index}, but meta/ says {entry.length}; "
            "they must agree"
        )


def _encoded(cell: object, path: Path, column: str, row: int) -> bytes:
    if isinstance(cell, dict) and isinstance(cell.get("bytes"), bytes):
        return cell["bytes"]
    raise RecordingError(f"{path}, column {column!r}, row {row}: the cell has no image bytes")


def _stamped(path: Path) -> tuple[Path, int]:
    """A cache key that changes when the file does."""
    try:
        return path, path.stat().st_mtime_ns
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from None


# Episodes are read in order, and hundreds of them can share a file or even a row group.
@lru_cache(maxsize=4)
def _episode_column(path: Path, stamp: int) -> NDArray[np.int64]:
    with opened(path) as file:
        if "episode_index" not in file.schema_arrow.names:
            raise RecordingError(
                f"{path}: missing column episode_index; it has {', '.join(file.schema_arrow.names)}"
            )
        return file.read(columns=["episode_index"]).column(0).to_numpy()


@lru_cache(maxsize=1)
def _read_groups(
    path: Path, stamp: int, groups: tuple[int, ...], wanted: tuple[str, ...]
) -> pa.Table:
    with opened(path) as file:
        columns = [name for name in wanted if name in file.schema_arrow.names]
        return file.read_row_groups(list(groups), columns=columns)
