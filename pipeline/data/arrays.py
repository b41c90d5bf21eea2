"""Numeric files -> arrays; errors name the file and the place in it."""

import csv
import zipfile
from array import array
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from pipeline.base.border import shown
from pipeline.base.config import MediaLimits
from pipeline.base.errors import RecordingError
from pipeline.data.recording import DEFAULT_LIMITS, INTACT, RECORDINGS, check_unpacked

Numbers = NDArray[Any]
"""An array of real numbers of any width."""
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
MOST_CHANNELS = 65_536
_LONGEST_LINE = 2**20


def read_npz(
    path: Path,
    wanted: Collection[str],
    text: Collection[str] = (),
    limits: MediaLimits = DEFAULT_LIMITS,
) -> dict[str, NDArray[Any]]:
    """The members of a .npz named in `wanted` (numbers) or in `text` (words).

    A missing member is left out, but at least one must be there. Raises `RecordingError`, which
    names file and member, where one is truncated, damaged, larger than the limits, or of another
    type; object arrays are refused unread.
    """
    members: dict[str, NDArray[Any]] = {}
    RECORDINGS.check_file(path)
    with RECORDINGS.foreign(path, "cannot be read as .npz"), zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            name = info.filename.removesuffix(".npy")
            where = f"{path}, member {name!r}"
            if name in members:
                raise RECORDINGS.refusal(where, "expected once, found twice")
            if name in wanted or name in text:
                check_unpacked(where, info.file_size, info.compress_size, limits)
                with RECORDINGS.foreign(where, "cannot be read"), archive.open(info) as file:
                    read = _read_array(file, info.file_size, where)
                members[name] = numeric(read, where) if name in wanted else _words(read, where)
        if not members:
            names = [name.removesuffix(".npy") for name in archive.namelist()]
            raise RecordingError(f"{path}: expected {' or '.join(wanted)}, found {_listed(names)}")
    return members


def read_npy(path: Path, limits: MediaLimits = DEFAULT_LIMITS) -> Numbers:
    """The one array of a .npy; errors as in `read_npz`."""
    size = RECORDINGS.check_file(path)
    check_unpacked(path, size, size, limits)
    with RECORDINGS.foreign(path, "cannot be read as .npy"), path.open("rb") as file:
        return numeric(_read_array(file, size, str(path)), str(path))


def _read_array(file: IO[bytes], size: int, where: str) -> NDArray[Any]:
    """The array of numbers or words in an open file of `size` bytes."""
    try:
        shape, _, dtype = _HEADERS[npy.read_magic(file)](file)
    except Exception:  # A damaged header makes numpy's parser raise almost any exception.
        why = "cannot be read as an array: its header is damaged or not numpy's"
        raise RECORDINGS.refusal(where, why) from None
    if dtype.kind not in "biufU":
        raise RECORDINGS.refusal(where, f"expected an array of numbers, found {dtype.name[:80]}")
    rest = size - file.tell()
    whole = all(type(n) is int and n >= 0 for n in shape)
    if not whole or prod(shape) * dtype.itemsize != rest:
        why = f"cannot be read: {shown(shape)} of {dtype} is not what its {rest:,} bytes hold"
        raise RECORDINGS.refusal(where, why)
    if not rest and shape[:1] > (0,):
        raise INTACT.refusal(where, f"expected rows with values, found {shown(shape)} of {dtype}")
    file.seek(0)
    return npy.read_array(file, allow_pickle=False)


def member(members: Mapping[str, Numbers], names: Sequence[str], path: Path) -> Numbers:
    """The member under the first of these names that exists; `RecordingError` if none does."""
    for name in names:
        if name in members:
            return members[name]
    raise RecordingError(
        f"{path}: no member {' or '.join(map(repr, names))}; it has {_listed(members)}"
    )


def numeric(array: Any, where: str) -> Numbers:
    """The array; `RecordingError` unless it holds rows of real numbers."""
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        kind = getattr(array, "dtype", type(array).__name__)
        raise RecordingError(f"{where}: expected an array of numbers, found {kind}")
    if array.ndim == 0:
        raise RecordingError(f"{where}: expected rows of numbers, found the single {array}")
    return array


def _words(array: NDArray[Any], where: str) -> NDArray[Any]:
    if array.dtype.kind != "U" or array.ndim != 1 or len(array) > MOST_CHANNELS:
        why = f"expected a list of at most {MOST_CHANNELS:,} words, found {array.dtype} of shape "
        raise INTACT.refusal(where, f"{why}{array.shape}")
    return array


def csv_header(path: Path) -> list[str]:
    """Column names of a CSV."""
    return [name.strip() for name in next(_csv_lines(path), (0, []))[1]]


def read_csv(path: Path, columns: Sequence[str]) -> NDArray[np.float64]:
    """The named columns (row, column) of a CSV with a header line, found by name.

    Raises `RecordingError`, which names missing or repeated columns, the line of a row that is
    longer or shorter than the header, or the line and column of a bad cell.
    """
    lines = _csv_lines(path)
    header = [name.strip() for name in next(lines, (0, []))[1]]
    for count, what in ((0, "missing column(s)"), (2, "twice the column(s)")):
        wrong = [name for name in columns if min(header.count(name), 2) == count]
        if wrong:
            raise RecordingError(f"{path}: {what} {', '.join(wrong)}; it has {_listed(header)}")
    places = [header.index(name) for name in columns]
    table = array("d")
    for line, row in lines:
        _check_width(path, line, row, header)
        try:
            # float() also accepts 1_000 and digits of other scripts; a table may not have them.
            table.extend(float(row[place].replace("_", "?").encode("ascii")) for place in places)
        except ValueError:
            column = len(table) % len(columns)
            raise RecordingError(
                f"{path}, line {line}, column {columns[column]!r}: {shown(row[places[column]])} "
                "is not a number"
            ) from None
    return np.frombuffer(table, np.float64).reshape(-1, len(columns))


def _csv_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Number and cells of each line that is not empty."""
    RECORDINGS.check_file(path)
    with (
        RECORDINGS.foreign(path, "cannot be read as CSV"),
        path.open(newline="", encoding="utf-8-sig") as file,
    ):
        reader = csv.reader(_bounded_lines(file, path))
        yield from ((reader.line_num, row) for row in reader if row)


def _bounded_lines(file: IO[str], path: Path) -> Iterator[str]:
    for number, line in enumerate(iter(partial(file.readline, _LONGEST_LINE), ""), start=1):
        if len(line) == _LONGEST_LINE:
            why = f"expected lines of fewer than {_LONGEST_LINE:,} characters, found more"
            raise RECORDINGS.refusal(f"{path}, line {number}", why)
        yield line


def _check_width(path: Path, line: int, row: Sequence[str], header: Sequence[str]) -> None:
    """Raise `RecordingError` for a row of more or fewer cells than the header names.

    It is unknown which cell is missing or extra, so every value may belong to a neighbouring
    channel. Empty cells at the end, from a trailing comma, shift nothing.
    """
    expected = len(header)
    if len(row) != expected and any((*row[expected:], *header[len(row) :])):
        why = "the line is cut off" if len(row) < expected else "its channels would be shifted"
        raise RecordingError(
            f"{path}, line {line}: expected {expected} cells as in the header, found {len(row)}; "
            f"{why}. Mend or delete the line"
        )


def _listed(names: Collection[str]) -> str:
    more = f", and {len(names) - 50:,} more" if len(names) > 50 else ""
    return ", ".join(shown(name)[1:-1] for name in [*names][:50]) + more or "nothing"
