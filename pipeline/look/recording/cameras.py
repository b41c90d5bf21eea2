"""What the cameras saw: frames at chosen ticks, and what looks wrong in the pictures.

A long episode costs no more than a short one:
- JPEG files: all are compared for duplicates (equal bytes are equal pictures); every frame that a
  VL row sees is decoded at an eighth of its size, as extraction does, and checked for one colour.
- Videos and pictures in rows: all frames of an episode of up to `MOST_FRAMES`, else `RUNS` runs of
  neighbours, evenly spread. The packets of a whole video are read in any case.

The pictures of a simulation, and of a video whose encoder skips what stands still, are equal
whenever nothing moves. So a camera counts as frozen only if every other camera of the episode sees
something move meanwhile, or if it never changes at all.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline.base.config import Params
from pipeline.base.errors import Issue
from pipeline.data import CameraStream
from pipeline.data.timeline import last_at
from pipeline.look.page.blocks import Block, Text
from pipeline.look.page.style import draw_frame, panels
from pipeline.look.recording.episode import BROKEN, Draw, LoadedRecording, runs

MOST_FRAMES, RUNS = 120, 12
# Standard deviation of the colour that varies most, of 255, up to which a frame shows nothing.
ONE_COLOUR = 2.0
# Equal pairs in a row that are a freeze, and the least number of differing pairs that every other
# view has meanwhile.
STILL_PAIRS, MOVING_PAIRS = 5, 20
_COLUMN_IN = 2.3


def camera_blocks(view: LoadedRecording, draw: Draw, params: Params) -> list[Block]:
    """The picture of the views at `inspect.ticks` ticks, and why a view is not shown.

    Empty without ticks or views.
    """
    if not (ticks := spread_ticks(view, params.inspect.ticks)):
        return []
    shown, broken = read_frames(view, ticks)
    absent = [Text(f"{issue.stream} is not shown: {issue.message}") for issue in broken]
    if not shown:
        return [*absent]
    caption = f"The last frame of each view at or before {len(ticks)} ticks, evenly spread."
    return [*absent, draw("views", caption, lambda view: draw_views(view, ticks))]


def spread_ticks(view: LoadedRecording, count: int) -> list[int]:
    """At most `count` different ticks, evenly from the first to the last; none without ticks."""
    last = -1 if view.timeline is None else len(view.timeline.time) - 1
    return np.unique(np.linspace(0, last, count).round().astype(int)).tolist() if last >= 0 else []


def read_frames(
    view: LoadedRecording, ticks: Sequence[int]
) -> tuple[dict[str, list[NDArray[np.uint8]]], tuple[Issue, ...]]:
    """By view, the last frame (height, width, 3) RGB at or before each of these rising ticks.

    Also an issue `unreadable` for each view that is left out because a frame cannot be read; a file
    may vanish after `find_frame_issues` has read it.
    """
    frames: dict[str, list[NDArray[np.uint8]]] = {}
    broken: list[Issue] = []
    for name, camera in view.cameras.items():
        try:
            frames[name] = list(camera.read(_shown_at(view, name, ticks).tolist()))
        except BROKEN as error:
            broken.append(view.issue("unreadable", f"view {name}", str(error), severity="error"))
    return frames, tuple(broken)


def draw_views(view: LoadedRecording, ticks: Sequence[int]) -> Figure:
    """The last frame of each view (row) at each tick (column), and how old it was then."""
    assert view.timeline is not None
    frames, _ = read_frames(view, ticks)
    time = view.timeline.time[list(ticks)]
    heights = [_COLUMN_IN * row[0].shape[0] / row[0].shape[1] + 0.25 for row in frames.values()]
    size = _COLUMN_IN * max(len(ticks), 2) + 0.4, sum(heights) + 0.6
    figure, axes = panels(*size, len(frames), len(ticks), squeeze=False, height_ratios=heights)
    for line, (name, row) in zip(axes, frames.items(), strict=True):
        ages = time - view.cameras[name].time[_shown_at(view, name, ticks)]
        for axis, frame, age in zip(line, row, ages, strict=True):
            draw_frame(axis, frame)
            axis.set_xlabel(f"{1000 * age:.0f} ms old", fontsize=8, labelpad=2)
        line[0].set_ylabel(name)
    for axis, tick, at in zip(axes[0], ticks, time - view.zero, strict=True):
        axis.set_title(f"tick {tick}, {at:.2f} s", fontsize=10)
    return figure


def _shown_at(view: LoadedRecording, name: str, ticks: Sequence[int]) -> NDArray[np.int64]:
    line = view.timeline
    assert line is not None
    return last_at(view.cameras[name].time, line.time[list(ticks)], line.slack_s)


@dataclass(frozen=True)
class _Compared:
    """The frames of a camera, compared.

    `index` (frame,) are the compared frames; `equal` (frame - 1,) is set where a frame equals the
    one before; `blank` says for each checked frame whether it is of one colour.
    """

    index: NDArray[np.int64]
    equal: NDArray[np.bool_]
    blank: dict[int, bool]


def find_frame_issues(view: LoadedRecording) -> Iterator[Issue]:
    """Issues of kind unreadable, dead camera and duplicate frames."""
    compared: dict[str, _Compared] = {}
    for name, camera in view.cameras.items():
        try:
            compared[name] = _compare(view, name, camera)
        except BROKEN as error:
            yield view.issue("unreadable", f"view {name}", str(error), severity="error")
    for name, own in compared.items():
        yield from _dead(view, name, own.blank)
        if not any(own.blank.values()):
            yield from _duplicates(view, name, compared)


def _compare(view: LoadedRecording, name: str, camera: CameraStream) -> _Compared:
    count, equal = len(camera.time), camera.repeats()
    if equal is not None and view.timeline is not None:
        served = np.unique(view.timeline.frames[name]).tolist()
        if (thumbnails := camera.check(served)) is not None:
            blank = dict(zip(served, map(_is_blank, thumbnails), strict=True))
            return _Compared(np.arange(count), equal, blank)
    index = _spread_runs(count)
    blank, repeats = dict[int, bool](), list[bool]()
    before: NDArray[np.uint8] | None = None
    for number, frame in zip(index.tolist(), camera.read(index.tolist()), strict=True):
        blank[number] = _is_blank(frame)
        if before is not None:
            repeats.append(np.array_equal(before, frame))
        before = frame
    return _Compared(index, np.array(repeats, np.bool_), blank)


def _is_blank(frame: NDArray[np.uint8]) -> bool:
    return bool(frame.std(axis=(0, 1)).max() <= ONE_COLOUR)


def _spread_runs(frames: int) -> NDArray[np.int64]:
    """All of at most `MOST_FRAMES` frames, else `RUNS` runs of neighbours, evenly spread."""
    if frames <= MOST_FRAMES:
        return np.arange(frames)
    length = MOST_FRAMES // RUNS
    starts = np.linspace(0, frames - length, RUNS).astype(np.int64)
    return np.unique(starts[:, None] + np.arange(length))


def _dead(view: LoadedRecording, name: str, blank: Mapping[int, bool]) -> Iterator[Issue]:
    time, frames = view.cameras[name].time, list(blank)
    for first, stop in runs(np.array(list(blank.values()), np.bool_)):
        start, last = frames[first], frames[stop - 1]
        message = (
            f"frames {start} to {last}, {stop - first} of the {len(frames)} looked at, are of one "
            "colour"
        )
        span = float(time[start]), float(time[last])
        yield view.issue("dead camera", f"view {name}", message, *span)


def _duplicates(
    view: LoadedRecording, name: str, compared: Mapping[str, _Compared]
) -> Iterator[Issue]:
    own, kind, stream = compared[name], "duplicate frames", f"view {name}"
    if len(own.equal) >= STILL_PAIRS and own.equal.all():
        message = f"all {len(own.index)} frames looked at are one picture; expected a moving one"
        yield view.issue(kind, stream, message)
        return
    time = view.cameras[name].time
    for first, last in runs(own.equal):
        start, stop = own.index[[first, last]].tolist()
        span = float(time[start]), float(time[stop])
        if last - first >= STILL_PAIRS and _others_move(view, name, compared, *span):
            message = f"frames {start} to {stop} are one picture, while other views move"
            yield view.issue(kind, stream, message, *span)


def _others_move(
    view: LoadedRecording,
    name: str,
    compared: Mapping[str, _Compared],
    start_s: float,
    stop_s: float,
) -> bool:
    """Whether there are other cameras, and each of them sees changes between two instants."""
    moving: list[int] = []
    for other in compared.keys() - {name}:
        time = view.cameras[other].time[compared[other].index]
        inside = (time[:-1] >= start_s) & (time[1:] <= stop_s)
        moving.append(int(np.count_nonzero(inside & ~compared[other].equal)))
    return bool(moving) and min(moving) >= MOVING_PAIRS
