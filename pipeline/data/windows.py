"""Overlapping, abutting or gapped sensor windows -> the stream they were cut from.

A recorder cuts windows at a fixed stride, and stamps each with the time of its last reading. Its
clock jitters, so the stride is taken from the clock and then proved on the overlapping data.
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.base.arrays import first_non_finite
from pipeline.base.errors import RecordingError
from pipeline.data.arrays import Numbers

_OVERLAP = 0.75
"""Windows overlap for certain where the clock advances by less than this fraction of one."""
_PAIRS_ASKED = 16
_SHIFTS_TRIED = 32
"""Nearest to the expected stride: readings agree at one shift, or, where they stand still, at the
nearest."""


def rebuild(
    ends: NDArray[np.float64], windows: Numbers, sensor_hz: float | None, where: str
) -> tuple[NDArray[np.float64], Numbers]:
    """Clock (reading,) s and readings (reading, channel) without the duplicates.

    `ends` (window,) never decreases; `windows` is (window, reading, channel). Readings are spread
    evenly between the ends of windows that overlap or abut; after a gap, and in the first window,
    they are dated back from the end at `sensor_hz`. Raises `RecordingError` where windows overlap
    by the clock and their readings differ, and on NaN or inf.
    """
    _check_finite(windows, where)
    width = windows.shape[1]
    fresh = np.array([width, *_strides(ends, windows, sensor_hz, where)])
    rate_hz = sensor_hz or _estimated_rate(ends, fresh, where)
    usual = np.median(fresh[1:]) if len(ends) > 1 else width
    times = [ends[0] - np.arange(width)[::-1] / rate_hz]
    for previous, end, count in zip(ends[:-1], ends[1:], fresh[1:], strict=True):
        missing = (end - previous) * rate_hz - count
        if missing > 0.5 * min(usual, count):
            times.append(end - np.arange(count)[::-1] / rate_hz)
        else:
            times.append(previous + (end - previous) * np.arange(1, count + 1) / max(count, 1))
    values = [window[width - count :] for window, count in zip(windows, fresh, strict=True)]
    return np.concatenate(times), np.concatenate(values)


def _strides(
    ends: NDArray[np.float64], windows: Numbers, sensor_hz: float | None, where: str
) -> list[int]:
    """How many readings each window but the first adds to the one before."""
    width = windows.shape[1]
    if len(ends) < 2:
        return []
    steps = np.diff(ends)
    proved = _proved_stride(windows)
    if sensor_hz is not None:
        expected = steps * sensor_hz
    else:
        expected = steps / (np.median(steps) or np.inf) * (proved or width)
    typical = float(np.median(expected))
    usual = proved or min(round(typical), width)
    overlapping = typical < _OVERLAP * width
    strides: list[int] = []
    for index, step in enumerate(expected, start=1):
        near = usual if abs(step - typical) <= 0.5 * typical else float(step)
        previous, window = windows[index - 1], windows[index]
        shifts = sorted([*_first_rows(previous, window), width], key=lambda s: abs(s - near))
        stride = next(
            s for s in (*shifts[:_SHIFTS_TRIED], width) if s == width or _agree(previous, window, s)
        )
        if stride == width and overlapping and step < _OVERLAP * width:
            raise RecordingError(
                f"{where}: windows {index - 1} and {index} overlap by the clock (stride "
                f"{step:.0f} of {width} readings), but no shift of their readings agrees; "
                "check timestamps and sensor_hz"
            )
        strides.append(stride)
    return strides


def _check_finite(windows: Numbers, where: str) -> None:
    for index, window in enumerate(windows):
        if (bad := first_non_finite(window)) is not None:
            raise RecordingError(
                f"{where}: {window[bad]} in window {index}, reading {bad[0]}, channel {bad[1]}"
            )


def _proved_stride(windows: Numbers) -> int | None:
    """The stride at which most of some window pairs agree; None where the data does not tell."""
    asked = np.unique(np.linspace(1, len(windows) - 1, _PAIRS_ASKED).astype(int))
    votes: Counter[int] = Counter()
    for index in asked:
        previous, window = windows[index - 1], windows[index]
        shifts = _first_rows(previous, window)
        # Readings that do not change agree at every shift and prove nothing.
        if len(shifts) == 1 and _agree(previous, window, shifts[0]):
            votes[shifts[0]] += 1
    stride, count = max(votes.items(), key=lambda vote: vote[1], default=(0, 0))
    return stride if 2 * count > len(asked) else None


def _first_rows(previous: Numbers, window: Numbers) -> Sequence[int]:
    """Where in the previous window this window's first reading stands."""
    same = np.flatnonzero(previous[:, 0] == window[0, 0])
    return [int(row) for row in same if np.array_equal(previous[row], window[0])]


def _agree(previous: Numbers, window: Numbers, stride: int) -> bool:
    return np.array_equal(previous[stride:], window[: len(window) - stride])


def _estimated_rate(ends: NDArray[np.float64], fresh: NDArray[np.int64], where: str) -> float:
    steps = np.diff(ends)
    if not steps.size or not np.median(steps) > 0:
        raise RecordingError(
            f"{where}: the readings inside a window cannot be dated: metadata.json has no "
            "sensor_hz, and the window times do not tell"
        )
    return float(np.median(fresh[1:]) / np.median(steps))
