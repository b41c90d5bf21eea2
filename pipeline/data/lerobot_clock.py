"""When the rows of a LeRobot episode were recorded.

LeRobot stores `timestamp` as float32, in which 0.1 is 0.10000000149. Where the stored times are
those of the frame numbers at `fps`, the clock is computed from the numbers, without that rounding.
"""

from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.base.errors import RecordingError
from pipeline.data.lerobot_rows import CLOCK, ParquetRows, matrix
from pipeline.data.media import RECORDINGS
from pipeline.data.recording import check_clock, check_resolution, check_rising_clock

FRAME = "frame_index"
NUMBERS = (CLOCK, FRAME)

_ROUNDINGS = 2
"""Steps of the stored type by which a time may differ from that of its frame number: the writer
may have multiplied by a rounded 1 / fps."""
_LATEST_S = 1e12
"""Nanoseconds reach it in a quarter of an hour: no clock is in seconds there."""
_UNITS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}


def read_clock(table: pa.Table, fps: float, where: str) -> NDArray[np.float64]:
    """(row,) s, rising: from frame numbers and `fps` where they agree with the stored times.

    Raises `RecordingError` where the clock does not rise or is not in seconds.
    """
    stored = stored_clock(table, where)
    check_clock(stored, f"{where}, {CLOCK!r}")
    check_resolution(stored.astype(_stored_type(table)), f"{where}, {CLOCK!r}")
    _check_seconds(stored, fps, where)
    time = _exact(stored, _stored_type(table), _frames(table, where), fps)
    # Rows are chosen by time: of two at one time, the earlier would show the later's frame.
    check_rising_clock(time, f"{where}, {CLOCK!r}")
    return time


def stored_clock(table: pa.Table, where: str) -> NDArray[np.float64]:
    """(row,) the column `timestamp` as it stands in the file."""
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

    They may begin above 0 and leave some out: rows can have been taken away.
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
    """(row,) the frame numbers; the rows' own where the column is absent."""
    if FRAME not in table.column_names:
        return np.arange(table.num_rows, dtype=np.float64)
    return matrix(table[FRAME], 1, f"{where}, {FRAME!r}")[:, 0]


def _stored_type(table: pa.Table) -> "np.dtype[Any]":
    """Of the column `timestamp`; float64 for whole numbers."""
    kind = table.schema.field(CLOCK).type
    kind = getattr(kind, "value_type", kind)
    return np.dtype(kind.to_pandas_dtype() if pa.types.is_floating(kind) else np.float64)


def _exact(
    stored: NDArray[np.float64], dtype: "np.dtype[Any]", frame: NDArray[np.float64], fps: float
) -> NDArray[np.float64]:
    """`offset + frame / fps` where all stored times are that but for the rounding of `dtype`.

    The offset is a whole number of frames, or the shortest decimal that is stored so. Times that
    were not rounded to a type narrower than float64 stay as they are.
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
