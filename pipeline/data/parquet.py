"""Reads parquet files whose declared sizes are within limits."""

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.border import shown
from pipeline.base.config import MediaLimits
from pipeline.data.media import INTACT, RECORDINGS, check_unpacked

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
        there = [name for name in wanted if name in names]
        if twice := [name for name in there if names.count(name) > 1]:
            raise INTACT.refusal(self.path, f"expected one column {twice[0]!r}, found more")
        # Arrow reads all leaves whose path begins with the column's name.
        begins = tuple(f"{name}." for name in there)
        schema = file.schema
        paths = [schema.column(place).path for place in range(len(schema))]
        leaves = [place for place, path in enumerate(paths) if f"{path}.".startswith(begins)]
        pages = unpacked = 0
        for rows in map(file.metadata.row_group, groups):
            for leaf in map(rows.column, leaves):
                pages += max(0, leaf.total_uncompressed_size)
                unpacked += max(0, leaf.total_uncompressed_size, leaf.num_values * _WIDEST)
        check_unpacked(self.path, unpacked, self.path.stat().st_size, self.limits)
        return there, pages

    def rows(self, wanted: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
        """The place of each row (for messages) and its cells in those wanted columns that exist."""
        with self.open() as file:
            there, largest = self.check(file, wanted, range(file.num_row_groups))
            # A text stored once may be in every row.
            rows = min(_BATCH_ROWS, _BATCH_BYTES // max(1, largest) + 1)
            number = 0
            for batch in file.iter_batches(rows, columns=there, use_threads=False):
                for row in batch.to_pylist():
                    yield f"{self.path}, row {number}", row
                    number += 1

    def numbers(self, wanted: Sequence[str], groups: Sequence[int] | None = None) -> pa.Table:
        """Those wanted columns that the file has, with numbers or lists of numbers.

        Reads these row groups; all of them where `groups` is None.
        """
        return _numbers(self, self._stamp(), tuple(wanted), groups and tuple(groups))

    def groups(self, start: int, stop: int) -> tuple[range, int]:
        """The row groups that hold these rows, and the first row of the first group."""
        counts = _row_counts(self, self._stamp())
        if sum(counts) < stop or min(counts) < 0:
            why = f"expected {stop} rows, found {sum(counts)} in its row groups"
            raise RECORDINGS.refusal(self.path, why)
        ends = np.cumsum(counts, dtype=np.int64)
        first = int(np.searchsorted(ends, start, side="right"))
        last = int(np.searchsorted(ends, stop, side="left"))
        return range(first, last + 1), int(ends[first] - counts[first])

    def _stamp(self) -> int:
        """A number that changes with the file."""
        RECORDINGS.check_file(self.path)
        return self.path.stat().st_mtime_ns


@lru_cache(maxsize=4)
def _row_counts(table: ParquetTable, stamp: int) -> list[int]:
    """Rows of each row group."""
    with table.open() as file:
        return [file.metadata.row_group(place).num_rows for place in range(file.num_row_groups)]


# Cached, because hundreds of episodes, read in order, can share a file or even a row group.
@lru_cache(maxsize=4)
def _numbers(
    table: ParquetTable, stamp: int, wanted: tuple[str, ...], groups: tuple[int, ...] | None
) -> pa.Table:
    with table.open() as file:
        groups = tuple(range(file.num_row_groups)) if groups is None else groups
        there, _ = table.check(file, wanted, groups)
        schema = file.schema_arrow
        for name in there:
            kind = number = schema.field(name).type
            if isinstance(kind, pa.ListType | pa.LargeListType | pa.FixedSizeListType):
                number = kind.value_type
            if not (pa.types.is_floating(number) or pa.types.is_integer(number)):
                where = f"{table.path}, column {name!r}"
                raise RECORDINGS.refusal(where, f"expected numbers, found {shown(str(kind))}")
        return file.read_row_groups(list(groups), columns=there)
