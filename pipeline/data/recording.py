"""A recording of any format on disk.

A `Recording` is one episode. To make one reads only metadata; `state()`, `sensor()`, `poses()` and
`action()` each read a complete numeric stream; `cameras()` lists clocks and leaves the pixels on
disk until `CameraStream.read` decodes them one frame at a time.

Times are float64 seconds on the recording's own clock and never decrease. Every fault raises
`RecordingError` with the file and the place in it.
"""

import json
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.base.arrays import first_non_finite, non_finite
from pipeline.base.config import MediaLimits, Source
from pipeline.base.digests import joint_digest
from pipeline.base.documents import Border, Document, Text
from pipeline.base.errors import RecordingError
from pipeline.base.provenance import CLOCK_SLACK_S

RECORDINGS = Border(RecordingError, "Copy or write the file again, or leave the episode out.")
DEFAULT_LIMITS = MediaLimits()
"""Limits of a file that does not belong to a source."""
FARTHEST_S = 1e20
"""Largest absolute time: nanoseconds since 1970 are 1e18."""
Seconds = Annotated[float, Field(ge=-FARTHEST_S, le=FARTHEST_S)]
Rate = Annotated[float, Field(ge=1e-3, le=1e6)]
"""Rate of a stream, in Hz."""
_MOST_BYTES = 2**38
"""Largest allowed size of an episode's file; a larger one is refused unread."""
ActionKind = Literal["absolute", "velocity", "delta"]


class Grouped(Document):
    """Metadata of an episode that may name its group."""

    group: Text | Annotated[int, Field(ge=-(10**9), lt=10**9)] | None = None

    @property
    def group_name(self) -> str | None:
        """The episode's group as text; None where it names none."""
        return None if self.group in (None, "") else str(self.group)


@dataclass(frozen=True)
class Channels:
    """Names and units of the columns of a stream; the unit of an unnamed quantity is ''."""

    names: tuple[str, ...]
    units: tuple[str, ...]


@dataclass(frozen=True)
class Stream:
    """A clocked stream: `time` (reading,) float64 s, `values` (reading, channel) float32."""

    channels: Channels
    time: NDArray[np.float64]
    values: NDArray[np.float32]


@dataclass(frozen=True)
class RecordedAction(Stream):
    """Actions that the recorder wrote.

    `kind` decides whether they may be resampled (`delta` may not); `rate_hz` is the nominal rate,
    if the recording names one.
    """

    kind: ActionKind
    rate_hz: float | None


class CameraStream(ABC):
    """One view of one episode; `time` (frame,) float64 s has the capture time of each frame."""

    view: str
    time: NDArray[np.float64]

    @property
    def covered(self) -> NDArray[np.float64]:
        """(entry,) s, a clock: the view shows a frame from its first to its last entry.

        It is `time`, unless a frame is in several rows: then it is the rows' clock.
        """
        return self.time

    @abstractmethod
    def check(self, indices: Sequence[int]) -> NDArray[np.uint8] | None:
        """Raise `RecordingError`, which names the first of these frames that cannot be decoded.

        It is cheaper than `read` and runs before anything expensive. Returns thumbnails (index,
        height, width, 3), RGB, all of the same small size, if the check decodes frames, else None.
        """

    @abstractmethod
    def read(self, indices: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
        """Yield the frames (height, width, 3), RGB, for `indices` in never decreasing order.

        Holds one decoded frame at a time and never seeks backwards.
        """

    def repeats(self) -> NDArray[np.bool_] | None:
        """(frame - 1,) whether a frame equals the one before; None if that needs decoding."""
        return None


class Recording(ABC):
    """One episode on disk, with the params of its source."""

    format: str
    id: str
    """Unique within its source: the folder's name, with parents if needed, or `episode_000003`."""
    source: str
    path: Path

    def __init__(self, path: Path, source: Source, views: Sequence[str] | None) -> None:
        """Only the views in `views` are kept; all where `views` is None."""
        self.path = path
        self.id = path.name
        self.source = source.name
        self._overrides = source
        self._views = None if views is None else frozenset(views)

    # Read on first use, because the old format has it in the pickle, which is not read on opening.
    @cached_property
    def instruction(self) -> str:
        """The source's instruction, or else the recording's own."""
        if self._overrides.instruction is not None:
            return self._overrides.instruction
        return self._recorded_instruction()

    @abstractmethod
    def files(self) -> list[Path]:
        """Every file whose bytes decide the episode's content, sorted."""

    @abstractmethod
    def all_views(self) -> Sequence[str]:
        """Names of the views before the filter, without reading any numeric stream."""

    @abstractmethod
    def _recorded_instruction(self) -> str: ...

    @abstractmethod
    def _cameras(self) -> Mapping[str, CameraStream]:
        """The views that have at least one frame; may include views that the filter drops."""

    def _wants(self, view: str) -> bool:
        return self._views is None or view in self._views

    def identity(self) -> str:
        """Text that distinguishes this episode from others in the same files; often ''."""
        return ""

    def cameras(self) -> Mapping[str, CameraStream]:
        """The kept views that have at least one frame, by name."""
        return {view: camera for view, camera in self._cameras().items() if self._wants(view)}

    def view_names(self) -> Sequence[str]:
        """Names of the kept views, without reading any numeric stream."""
        return [view for view in self.all_views() if self._wants(view)]

    @property
    def group(self) -> str | None:
        """The recording's group, such as an object or a day; None where it names none.

        Training holds out whole groups.
        """
        return None

    def state(self) -> Stream | None:
        """The robot state, or None where the episode has none."""
        return None

    def sensor(self) -> Stream | None:
        """The high-rate sensor, or None where the episode has none."""
        return None

    @property
    def has_poses(self) -> bool:
        """Whether `poses()` returns a stream; known without reading it."""
        return False

    def poses(self) -> Stream | None:
        """Tool poses x y z (mm) a b r (deg, mobile XYZ) to derive actions from, or None."""
        return None

    def action(self) -> RecordedAction | None:
        """Recorded actions, or None where they must be derived from `poses()`."""
        return None


def checked_stream(
    channels: Channels, stored: NDArray[Any], values: NDArray[Any], where: str
) -> Stream:
    """A checked `Stream`; `stored` is its clock as in the file.

    Raises `RecordingError`, which begins with `where`, on different lengths, a width other than the
    channels', an empty stream, NaN or inf (it names row and channel), and a clock that goes
    backwards or is too coarse.
    """
    time = np.asarray(stored, np.float64)
    with np.errstate(over="ignore"):  # too large for float32 becomes inf, which is refused
        values = np.asarray(values, np.float32)
    if values.ndim != 2 or values.shape[1] != len(channels.names):
        raise RecordingError(
            f"{where}: expected rows of {len(channels.names)} values, found shape {values.shape}"
        )
    if time.shape != (len(values),):
        raise RecordingError(
            f"{where}: {len(values)} rows but {time.size} timestamps; they must agree"
        )
    if not values.size:
        raise RecordingError(f"{where}: the stream is empty")
    check_clock(time, where)
    check_resolution(stored, where)
    if (at := first_non_finite(values)) is not None:
        row, column = at
        raise RecordingError(
            f"{where}: {values[at]} in row {row}, {time[row] - time[0]:.3f} s after the "
            f"first, channel {channels.names[column]!r} ({int(non_finite(values).sum())} such "
            "values in all). "
            "Mend the recording or leave it out: nothing is filled in"
        )
    return Stream(channels, time, values)


def check_clock(time: NDArray[np.float64], where: str, rising: bool = False) -> None:
    """Raise `RecordingError` where a clock is not finite, farther from zero than `FARTHEST_S`, or
    goes backwards; with `rising`, also where it stands still."""
    far = np.flatnonzero(~(np.abs(time) <= FARTHEST_S))
    if far.size:
        raise RECORDINGS.refusal(
            where, f"timestamp {time[far[0]]} in row {far[0]}, expected seconds"
        )
    steps = np.diff(time)
    wrong = np.flatnonzero(steps <= 0 if rising else steps < 0)
    if wrong.size:
        row = int(wrong[0]) + 1
        course = "goes backwards" if steps[wrong[0]] < 0 else "stands still"
        raise RecordingError(
            f"{where}: the clock {course} at row {row}: {time[row]:.6f} s after "
            f"{time[row - 1]:.6f} s{'; it must rise from row to row' * rising}"
        )


def check_resolution(stored: NDArray[Any], where: str) -> None:
    """Raise `RecordingError` where a clock, in the type of its file, is too coarse for its rate.

    It is too coarse if on average more than two entries share one step of the type, or of the
    decimals to which all times are rounded.
    """
    time = stored.astype(np.float64)
    apart = (time[-1] - time[0]) / (len(time) - 1) if len(time) > 1 else 1.0
    rounded = next((10.0**-n for n in range(3) if (np.round(time, n) == time).all()), 0.0)
    spacing = np.spacing(np.abs(stored).max()) if stored.dtype.kind == "f" else 0.0
    if (step := max(rounded, float(spacing))) > max(2 * apart, CLOCK_SLACK_S):
        raise RecordingError(
            f"{where}: times of {stored.dtype} near {time[-1]:.0f} s go by steps of {step:g} s, "
            f"too coarse for {len(time)} of them in {time[-1] - time[0]:g} s; expected float64, "
            "not rounded. Export the recording again with such times, or leave it out"
        )


def check_limit(where: Path | str, count: int, most: int, name: str, what: str) -> None:
    """Refuse a count above `limits.<name>` of its source."""
    if count > most:
        raise Border(
            RecordingError,
            f"Leave the episode out, or if this is right, raise limits.{name} of its source.",
        ).refusal(where, f"expected at most {most:,} {what}, found {count:,}")


def check_unpacked(where: Path | str, unpacked: int, limits: MediaLimits) -> None:
    """Refuse an array or table with too many unpacked bytes, before it is read."""
    check_limit(where, unpacked, limits.array_bytes, "array_bytes", "bytes unpacked")


def content_digest(recording: Recording, digest_of: Callable[[Path], str]) -> str:
    """Digest of a recording's files, in any folder; equal content means equal streams.

    `digest_of` returns the digest of one file. Raises `RecordingError`, and what `digest_of` raises
    where a file cannot be read.
    """
    # Frame times are in file names, so a name is content too; the folder's path is not.
    named: list[tuple[str, str]] = []
    inside = f"{recording.path}/"
    for file in recording.files():
        name = str(file)
        RECORDINGS.check_file(file, _MOST_BYTES)
        below = name.startswith(inside)
        name = name[len(inside) :] if below else os.path.relpath(file, recording.path)
        named.append((name, digest_of(file)))
    return joint_digest(recording.identity(), json.dumps(sorted(named)))


def entries(folder: Path) -> list[os.DirEntry[str]]:
    """The entries of a folder; `RecordingError` where it cannot be listed."""
    with RECORDINGS.foreign(folder, "cannot be listed"), os.scandir(folder) as listed:
        return list(listed)


def absolute(path: Path) -> Path:
    """The path made absolute without following symbolic links."""
    return Path(os.path.abspath(path))


def natural_key(text: str | Path) -> list[tuple[int, int, str]]:
    """A sort key that puts `View2` before `View10`."""
    parts = re.split(r"(\d+)", str(text))
    return [(0, int(part), part) if part.isdecimal() else (1, 0, part) for part in parts]
