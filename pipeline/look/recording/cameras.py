"""What the cameras saw: frames at chosen ticks, and what looks wrong in the pictures.

A long episode costs no more than a short one:
- JPEG files: all are compared for duplicates (equal bytes are equal pictures); every frame that a
  VL row sees is decoded at an eighth of its size, as extraction does, and checked for one colour;
  `RUNS` pairs of neighbours, evenly spread, are decoded whole.
- Videos and pictures in rows: all frames of an episode of up to `MOST_FRAMES`, else `RUNS` runs of
  neighbours, evenly spread. The packets of a whole video are read in any case.

Equal pictures prove a frozen camera only if its pictures have noise: if most pixels differ between
neighbours, also just before and after equal ones. The pictures of a simulation, and of a video
whose encoder skips what stands still, are equal whenever nothing moves. Such a camera counts as
frozen if every other camera of the episode sees something move meanwhile; a single camera counts as
frozen only if it never changes at all.
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
from pipeline.look.recording.episode import BROKEN, Draw, EpisodeView, runs

MOST_FRAMES, RUNS = 120, 12
# Standard deviation of the colour that varies most, of 255, up to which a frame shows nothing.
ONE_COLOUR = 2.0
# Equal pairs in a row that are a freeze of a camera with noise, and the share of all pairs from
# which single equal pairs are an issue.
DUPLICATES, DUPLICATE_SHARE = 3, 0.1
# The same for a camera without noise: equal pairs in a row, and the least number of differing pairs
# that every other view has meanwhile.
STILL_PAIRS, MOVING_PAIRS = 5, 20
# Share of the pixels that differ between neighbours where pictures have noise, at least in nine of
# ten pairs.
NOISY = 0.3
_COLUMN_IN = 2.3


def camera_blocks(view: EpisodeView, draw: Draw, params: Params) -> list[Block]:
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


def spread_ticks(view: EpisodeView, count: int) -> list[int]:
    """At most `count` different ticks, evenly from the first to the last; none without ticks."""
    last = -1 if view.timeline is None else len(view.timeline.time) - 1
    return np.unique(np.linspace(0, last, count).round().astype(int)).tolist() if last >= 0 else []


def read_frames(
    view: EpisodeView, ticks: Sequence[int]
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


def draw_views(view: EpisodeView, ticks: Sequence[int]) -> Figure:
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


def _shown_at(view: EpisodeView, name: str, ticks: Sequence[int]) -> NDArray[np.int64]:
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
    noisy: bool


def find_frame_issues(view: EpisodeView) -> Iterator[Issue]:
    """Issues of kind unreadable, dead camera and duplicate frames."""
    compared: dict[str, _Compared] = {}
    for name, camera in view.cameras.items():
        try:
            compared[name] = _compare(view, name, camera)
        except BROKEN as error:
            yield view.issue("unreadable", f"view {name}", str(error), severity="error")
    for name, own in compared.items():
        yield from _dead(view, name, own.blank)
        if not all(own.blank.values()):
            yield from _duplicates(view, name, compared)


def _compare(view: EpisodeView, name: str, camera: CameraStream) -> _Compared:
    count, repeats = len(camera.time), camera.repeats()
    blank: dict[int, bool] = {}
    if repeats is not None and view.timeline is not None:
        served = np.unique(view.timeline.frames[name]).tolist()
        if (thumbnails := camera.check(served)) is not None:
            blank = dict(zip(served, map(_is_blank, thumbnails), strict=True))
    index = _spread_runs(count, MOST_FRAMES if repeats is None else 2 * RUNS)
    check_all, shares = not blank, list[float]()
    before: NDArray[np.uint8] | None = None
    for number, frame in zip(index.tolist(), camera.read(index.tolist()), strict=True):
        if check_all:
            blank[number] = _is_blank(frame)
        if before is not None:
            shares.append(_share_differing(before, frame))
        before = frame
    differing = np.array(shares)
    neighbours = differing[(differing > 0) & (np.diff(index) == 1)]
    noisy = len(neighbours) > 0 and float(np.percentile(neighbours, 10)) > NOISY
    if repeats is None:
        return _Compared(index, differing == 0, blank, noisy)
    noisy = noisy and all(share > NOISY for share in _beside(camera, repeats))
    return _Compared(np.arange(count), repeats, blank, noisy)


def _is_blank(frame: NDArray[np.uint8]) -> bool:
    return bool(frame.std(axis=(0, 1)).max() <= ONE_COLOUR)


def _share_differing(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> float:
    """Share of pixels that differ; 1 if the sizes differ."""
    return float((before != after).any(axis=2).mean()) if before.shape == after.shape else 1.0


def _beside(camera: CameraStream, equal: NDArray[np.bool_]) -> Iterator[float]:
    """Share of pixels that differ just before and just after the longest runs of equal pairs."""
    for first, last in sorted(runs(equal), key=lambda run: run[0] - run[1])[:RUNS]:
        for place in (first - 1, last):
            if 0 <= place < len(equal):
                yield _share_differing(*camera.read([place, place + 1]))


def _spread_runs(frames: int, most: int) -> NDArray[np.int64]:
    """All frames if they are at most `most`, else `RUNS` runs of neighbours, evenly spread."""
    if frames <= most:
        return np.arange(frames)
    length = most // RUNS
    starts = np.linspace(0, frames - length, RUNS).astype(np.int64)
    return np.unique(starts[:, None] + np.arange(length))


def _dead(view: EpisodeView, name: str, blank: Mapping[int, bool]) -> Iterator[Issue]:
    time, frames = view.cameras[name].time, list(blank)
    for first, stop in runs(np.array(list(blank.values()), np.bool_)):
        if stop - first == len(frames):
            message, span = f"all {len(frames)} frames looked at are of one colour", ()
        else:
            start, last = frames[first], frames[stop - 1]
            message = f"frames {start} to {last}, {stop - first} of the {len(frames)} looked at, "
            message, span = f"{message}are of one colour", (float(time[start]), float(time[last]))
        yield view.issue("dead camera", f"view {name}", message, *span)


def _duplicates(view: EpisodeView, name: str, compared: Mapping[str, _Compared]) -> Iterator[Issue]:
    own, kind, stream = compared[name], "duplicate frames", f"view {name}"
    pairs = len(own.equal)
    if pairs >= STILL_PAIRS and own.equal.all():
        message = f"all {pairs + 1} frames looked at are one picture; expected a running camera"
        yield view.issue(kind, stream, message)
        return
    time, single = view.cameras[name].time, own.equal.copy()
    dead = [number for number, blank in own.blank.items() if blank]
    for first, last in runs(own.equal):
        start, stop = own.index[[first, last]].tolist()
        if any(start <= number <= stop for number in dead):  # an issue of its own
            single[first:last] = False
            continue
        span = float(time[start]), float(time[stop])
        long = last - first >= (DUPLICATES if own.noisy else STILL_PAIRS)
        if long and (own.noisy or _others_move(view, name, compared, *span)):
            single[first:last] = False
            why = "elsewhere frames differ" if own.noisy else "other views move"
            message = f"frames {start} to {stop} are one picture; {why}"
            yield view.issue(kind, stream, message, *span)
    again = time[own.index[1:][single]]
    if own.noisy and len(again) >= DUPLICATES and len(again) > DUPLICATE_SHARE * pairs:
        message = f"{len(again)} of {pairs} frames compared are the picture before"
        yield view.issue(kind, stream, message, *again[[0, -1]].tolist())


def _others_move(
    view: EpisodeView, name: str, compared: Mapping[str, _Compared], start_s: float, stop_s: float
) -> bool:
    """Whether there are other cameras, and each of them sees changes between two instants."""
    moving: list[int] = []
    for other in compared.keys() - {name}:
        time = view.cameras[other].time[compared[other].index]
        inside = (time[:-1] >= start_s) & (time[1:] <= stop_s)
        moving.append(int(np.count_nonzero(inside & ~compared[other].equal)))
    return bool(moving) and min(moving) >= MOVING_PAIRS
