"""Numeric files -> arrays, with errors that name the file and the place in it."""

import csv
import json
import math
import zipfile
import zlib
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import RecordingError

Numbers = NDArray[Any]
"""An array of real numbers of any width."""
_DAMAGED = (
    OSError,
    EOFError,
    ValueError,
    RuntimeError,
    NotImplementedError,
    zipfile.BadZipFile,
    zlib.error,
)


def read_npz(
    path: Path, wanted: Collection[str], text: Collection[str] = ()
) -> dict[str, NDArray[Any]]:
    """Those members of a .npz that are wanted and there; those in `text` hold words.

    Raises `RecordingError` naming file and member where it is truncated, damaged, or holds
    something else than numbers; object arrays are refused unread.
    """
    members: dict[str, NDArray[Any]] = {}
    # np.load would leave the file open where the archive is damaged.
    with _damage_named(path, ".npz"), path.open("rb") as file:
        archive = np.load(file, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise RecordingError(f"{path}: expected a .npz archive, found a single array")
        for name in archive.files:
            where = f"{path}, member {name!r}"
            with _damage_named(where, ".npz"):
                if name in wanted:
                    members[name] = numeric(archive[name], where)
                elif name in text:
                    members[name] = _words(archive[name], where)
        if not members:
            raise RecordingError(
                f"{path}: expected {' or '.join(wanted)}, found {_listed(archive.files)}"
            )
    return members


def read_npy(path: Path) -> Numbers:
    """The one array of a .npy; errors as in `read_npz`."""
    with _damage_named(path, ".npy"), path.open("rb") as file:
        return numeric(np.load(file, allow_pickle=False), str(path))


@contextmanager
def _damage_named(where: Path | str, kind: str) -> Generator[None, None, None]:
    try:
        yield
    except RecordingError:
        raise
    except _DAMAGED as error:
        raise RecordingError(
            f"{where}: cannot be read as {kind}: {error}; copy the file again"
        ) from None


def member(members: Mapping[str, Numbers], names: Sequence[str], path: Path) -> Numbers:
    """The member under the first of its possible names; `RecordingError` where it has none."""
    for name in names:
        if name in members:
            return members[name]
    raise RecordingError(
        f"{path}: no member {' or '.join(map(repr, names))}; it has {_listed(members)}"
    )


def numeric(array: Any, where: str) -> Numbers:
    """The array, if it holds rows of real numbers."""
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        found = getattr(array, "dtype", type(array).__name__)
        raise RecordingError(f"{where}: expected an array of numbers, found {found}")
    if array.ndim == 0:
        raise RecordingError(f"{where}: expected rows of numbers, found the single {array}")
    return array


def _words(array: NDArray[Any], where: str) -> NDArray[Any]:
    if array.dtype.kind != "U" or array.ndim != 1:
        raise RecordingError(f"{where}: expected a list of words, found {array.dtype}")
    return array


def csv_header(path: Path) -> list[str]:
    """Column names of a CSV."""
    return [name.strip() for name in next(_csv_lines(path), (0, []))[1]]


def read_csv(path: Path, columns: Sequence[str]) -> NDArray[np.float64]:
    """The named columns (row, column) of a CSV with a header line, found by name.

    Raises `RecordingError` naming missing columns, the line of a row that is longer or shorter than
    the header, or the line and column of a bad cell.
    """
    header, lines = csv_header(path), [*_csv_lines(path)][1:]
    missing = [name for name in columns if name not in header]
    if missing:
        raise RecordingError(
            f"{path}: missing column(s) {', '.join(missing)}; it has {_listed(header)}"
        )
    places = {name: header.index(name) for name in columns}
    table = np.empty((len(lines), len(columns)))
    for values, (line, row) in zip(table, lines, strict=True):
        _check_width(f"{path}, line {line}", row, header)
        for index, (name, place) in enumerate(places.items()):
            try:
                values[index] = float(row[place])
            except ValueError:
                raise RecordingError(
                    f"{path}, line {line}, column {name!r}: {row[place]!r} is not a number"
                ) from None
    return table


def _csv_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Number and cells of each line that is not empty."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            yield from ((reader.line_num, row) for row in reader if row)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise RecordingError(f"{path}: cannot be read as CSV: {error}") from None


def _check_width(where: str, row: Sequence[str], header: Sequence[str]) -> None:
    """Raise `RecordingError` for a row of more or fewer cells than the header names.

    Which cell is missing or too many cannot be known, so every channel may be a neighbour's. Empty
    cells at the end, as a last comma makes them, shift nothing.
    """
    expected = len(header)
    if len(row) != expected and any((*row[expected:], *header[len(row) :])):
        why = "the line is cut off" if len(row) < expected else "its channels would be shifted"
        raise RecordingError(
            f"{where}: expected {expected} cells as in the header, found {len(row)}; {why}. Mend "
            "or delete the line"
        )


def read_json(path: Path) -> dict[str, Any]:
    """The object that a JSON file holds."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: cannot be read as JSON: {error}") from None
    if not isinstance(document, dict):
        raise RecordingError(f"{path}: expected a JSON object, found {type(document).__name__}")
    return document


def number(
    document: Mapping[str, Any], key: str, where: str, *, positive: bool = False
) -> float | None:
    """A number of a metadata object, None where it is absent or null."""
    value = document.get(key)
    if value is None:
        return None
    wanted = "a positive number" if positive else "a number"
    real = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not real or not math.isfinite(value) or (positive and value <= 0):
        raise RecordingError(f"{where}: {key} must be {wanted}, found {value!r}")
    return float(value)


def group_name(document: Mapping[str, Any], where: str) -> str | None:
    """The `group` of a metadata object, None where it is absent, null or empty."""
    value = document.get("group")
    if value is None or value == "":
        return None
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise RecordingError(f"{where}: group must be a name or a whole number, found {value!r}")
    return str(value)


def _listed(names: Collection[str]) -> str:
    return ", ".join(names) or "nothing"
