"""What the three formats of the needle-insertion recorder share.

These are the channels, the task folder's name as instruction, JPEG views, robot states and sensor
rows.
"""

import os
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import MediaLimits
from pipeline.base.errors import RecordingError
from pipeline.data.arrays import Numbers, csv_header, member, read_csv, read_npz
from pipeline.data.jpeg import JpegCamera
from pipeline.data.recording import (
    RECORDINGS,
    CameraStream,
    Channels,
    Recording,
    Stream,
    absolute,
    checked_stream,
)

_JOINTS = tuple(f"joint_{joint}" for joint in range(1, 7))
_POSE = tuple(f"pose_{axis}" for axis in "xyzabr")
_POSE_UNITS = ("mm",) * 3 + ("deg",) * 3
STATE = Channels(_JOINTS + _POSE, ("deg",) * 6 + _POSE_UNITS)
POSES = Channels(_POSE, _POSE_UNITS)
ALINE_BINS = 1025
SENSOR = Channels(
    ("force", *(f"aline_{depth:04d}" for depth in range(ALINE_BINS))),
    ("N", *[""] * ALINE_BINS),
)
CLOCK = "origin_timestamp"
_CLOCK_TOLERANCE_S, _CLOCK_TOLERANCE = 0.5, 0.02
"""Largest allowed distance from the end of a clock made from start and rate to the recording's end:
in seconds, or as a share of the recording if that is more."""


class InsertionRecording(Recording):
    """An episode folder of the needle-insertion recorder."""

    @property
    def has_poses(self) -> bool:
        return robot_state_file(self.path) is not None

    def poses(self) -> Stream | None:
        state = self.state()
        if state is None:
            return None
        return Stream(POSES, state.time, np.ascontiguousarray(state.values[:, len(_JOINTS) :]))

    def files(self) -> list[Path]:
        data = (path for path in self._data_files() if path and os.path.lexists(path))
        views = (paths for view, paths in self._view_files().items() if self._wants(view))
        # Sorted as strings: to compare paths takes ten times as long.
        named = {str(path): path for path in chain(data, *views)}
        return [path for _, path in sorted(named.items())]

    def all_views(self) -> Sequence[str]:
        return list(self._view_files())

    def _recorded_instruction(self) -> str:
        return absolute(self.path).parent.name.replace("_", " ")

    def _cameras(self) -> Mapping[str, CameraStream]:
        return {
            view: JpegCamera(view, paths, self._overrides.limits)
            for view, paths in self._view_files().items()
            if self._wants(view)
        }

    @abstractmethod
    def _view_files(self) -> Mapping[str, list[Path]]:
        """JPEGs by view; a view without JPEGs is left out."""

    @abstractmethod
    def _data_files(self) -> Sequence[Path | None]:
        """Paths of the files that are not frames, whether they exist or not."""


def robot_state_file(folder: Path) -> Path | None:
    """`robot_states.npz`, else `robot_states.csv`; None where neither exists."""
    for name in ("robot_states.npz", "robot_states.csv"):
        if os.path.lexists(folder / name):
            return folder / name
    return None


def read_robot_states(
    path: Path,
    limits: MediaLimits,
    start: float | None,
    rate_hz: float | None,
    end: float | None = None,
) -> Stream:
    """Joints and poses; if the file has no clock, row i is at `start + i / rate_hz`.

    Such a clock must reach `end`, if the recording names one; raises `RecordingError` otherwise.
    """
    if path.suffix == ".csv" and CLOCK in csv_header(path):
        return read_state_csv(path)
    values = _states_of_npz(path, limits) if path.suffix == ".npz" else read_csv(path, STATE.names)
    if start is None or rate_hz is None:
        raise RecordingError(
            f"{path}: has no clock, and the episode's metadata gives no start_time and robot_hz "
            f"to make one; add them, or a column {CLOCK}"
        )
    if end is not None and len(values):
        _check_end(path, len(values), start, rate_hz, end)
    time = start + np.arange(len(values), dtype=np.float64) / rate_hz
    return checked_stream(STATE, time, values, str(path))


def _check_end(path: Path, rows: int, start: float, rate_hz: float, end: float) -> None:
    """Raise `RecordingError` where rows from `start` at `rate_hz` do not last until `end`."""
    last_s, span_s = (rows - 1) / rate_hz, end - start
    if abs(last_s - span_s) > max(_CLOCK_TOLERANCE_S, _CLOCK_TOLERANCE * span_s):
        fitting = f" (robot_hz {(rows - 1) / span_s:.4g} would fit)" if span_s > 0 else ""
        raise RecordingError(
            f"{path}: {rows} rows without a clock at robot_hz {rate_hz:g} last {last_s:.2f} s, but "
            f"from start_time {start:.3f} to end_time {end:.3f} are {span_s:.2f} s{fitting}; they "
            f"must agree: correct the metadata, or add a column {CLOCK}"
        )


def read_state_csv(path: Path) -> Stream:
    """The robot-state stream of a CSV that has `origin_timestamp`."""
    table = read_csv(path, (CLOCK, *STATE.names))
    return checked_stream(STATE, table[:, 0], table[:, 1:], str(path))


@np.errstate(over="ignore")
def sensor_rows(force: Numbers, aline: Numbers, where: str) -> NDArray[np.float32]:
    """Force (reading,) or (reading, 1) and A-lines (reading, 1025) -> (reading, 1026)."""
    if aline.ndim != 2 or aline.shape[1] != ALINE_BINS:
        raise RecordingError(
            f"{where}: expected A-lines (N, {ALINE_BINS}), found shape {aline.shape}"
        )
    if force.shape not in ((len(aline),), (len(aline), 1)):
        raise RecordingError(
            f"{where}: {len(aline)} A-lines but forces of shape {force.shape}; they must agree"
        )
    rows = np.empty((len(aline), 1 + ALINE_BINS), np.float32)
    rows[:, 0] = force.reshape(-1)
    rows[:, 1:] = aline
    return rows


def _states_of_npz(path: Path, limits: MediaLimits) -> Numbers:
    members = read_npz(path, ("robot_states", "joints", "poses"), limits=limits)
    if "robot_states" in members:
        return members["robot_states"]
    halves = [member(members, (name,), path) for name in ("joints", "poses")]
    with RECORDINGS.foreign(path, "expected joints and poses (M, 6)"):
        return np.concatenate(halves, axis=1)
