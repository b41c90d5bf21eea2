"""Numeric files -> arrays; errors name the file and the place in it."""

import csv
import zipfile
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow as pa
from numpy.lib import format as npy
from numpy.typing import NDArray
from pyarrow import csv as arrow_csv

from pipeline.base.config import MediaLimits
from pipeline.base.documents import named, shown
from pipeline.base.errors import RecordingError
from pipeline.data.recording import DEFAULT_LIMITS, RECORDINGS, check_unpacked

Numbers = NDArray[Any]
"""An array of real numbers of any width."""
_MOST_CSV_BYTES = 2**30
"""Largest CSV: a day of robot states at 100 Hz has half of it."""


def read_npz(
    path: Path,
    wanted: Collection[str],
    text: Collection[str] = (),
    limits: MediaLimits = DEFAULT_LIMITS,
) -> dict[str, NDArray[Any]]:
    """The members of a .npz named in `wanted` (numbers) or in `text` (words).

    A missing member is left out, but at least one must be there. Raises `RecordingError`, which
    names file and member, where one is truncated, damaged, larger than the limits, or not of
    numbers; a pickle inside is never opened.
    """
    members: dict[str, NDArray[Any]] = {}
    RECORDINGS.check_file(path)
    with RECORDINGS.foreign(path, "cannot be read as .npz"), zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            name = info.filename.removesuffix(".npy")
            where = f"{path}, member {name!r}"
            if name in wanted or name in text:
                check_unpacked(where, info.file_size, limits)
                with RECORDINGS.foreign(where, "cannot be read"), archive.open(info) as file:
                    read = _read_array(file, where)
                members[name] = numeric(read, where) if name in wanted else read
        if not members:
            names = [name.removesuffix(".npy") for name in archive.namelist()]
            raise RecordingError(f"{path}: expected {' or '.join(wanted)}, found {shown(names)}")
    return members


def read_npy(path: Path, limits: MediaLimits = DEFAULT_LIMITS) -> Numbers:
    """The one array of a .npy; errors as in `read_npz`."""
    check_unpacked(path, RECORDINGS.check_file(path), limits)
    with RECORDINGS.foreign(path, "cannot be read as .npy"), path.open("rb") as file:
        return numeric(_read_array(file, str(path)), str(path))


def _read_array(file: IO[bytes], where: str) -> NDArray[Any]:
    try:
        return npy.read_array(file, allow_pickle=False)
    except (ValueError, MemoryError):  # numpy advises to open a pickle, which could run code
        why = "cannot be read as an array: cut off, damaged, of objects, or too large for memory"
        raise RECORDINGS.refusal(where, why) from None


def member(members: Mapping[str, Numbers], names: Sequence[str], path: Path) -> Numbers:
    """The member under the first of these names that exists; `RecordingError` if none does."""
    for name in names:
        if name in members:
            return members[name]
    raise RecordingError(
        f"{path}: no member {' or '.join(map(repr, names))}; it has {shown([*members])}"
    )


def numeric(array: Any, where: str) -> Numbers:
    """The array; `RecordingError` unless it holds rows of real numbers."""
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu" or array.ndim == 0:
        kind = getattr(array, "dtype", type(array).__name__)
        shape = getattr(array, "shape", "")
        raise RecordingError(f"{where}: expected rows of numbers, found {kind} {shape}")
    return array


def csv_header(path: Path) -> list[str]:
    """Column names of a CSV."""
    RECORDINGS.check_file(path, _MOST_CSV_BYTES)
    with (
        RECORDINGS.foreign(path, "cannot be read as CSV"),
        path.open(newline="", encoding="utf-8-sig") as file,
    ):
        return [name.strip() for name in next(csv.reader(file), [])]


def read_csv(path: Path, columns: Sequence[str]) -> NDArray[np.float64]:
    """The named columns (row, column) of a CSV with a header line, found by name.

    Raises `RecordingError`, which names missing or repeated columns, the row that is longer or
    shorter than the header, or the row and column of a bad cell.
    """
    header = csv_header(path)
    if wrong := [name for name in columns if header.count(name) != 1]:
        raise RecordingError(
            f"{path}: expected one column {', '.join(wrong)} each; it has "
            f"{named(', '.join(header)[:900])}"
        )
    read = arrow_csv.ReadOptions(column_names=header, skip_rows=1, use_threads=False)
    convert = arrow_csv.ConvertOptions(
        include_columns=list(columns), column_types=dict.fromkeys(columns, pa.float64())
    )
    with RECORDINGS.foreign(path, "cannot be read as CSV"):
        table = arrow_csv.read_csv(path, read_options=read, convert_options=convert)
    cells = [matrix(table[name], 1, f"{path}, column {name!r}") for name in columns]
    return np.concatenate(cells, axis=1)


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
