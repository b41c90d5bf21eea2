"""What the cameras saw: frames at chosen ticks, and what looks wrong in the pictures.

What is looked at, so that a long episode costs no more than a short one:
- JPEG files: all of them for duplicates (two files are the same picture where their bytes are);
  every frame that a VL row sees is checked at an eighth of its size, as extraction does, looked at
  for one colour and asked for its size; `RUNS` pairs of neighbours, evenly spread, are decoded
  whole.
- Videos and pictures in rows: all frames of an episode of up to `MOST_FRAMES`, else `RUNS` runs of
  neighbours, evenly spread. The packets of a whole video are read in any case.

Equal pictures prove a frozen camera only where its pictures have noise: where most pixels differ
between neighbours, also between those just before and after equal ones. The pictures of a
simulation, and of a video whose encoder skips what stands still, are equal whenever nothing moves;
there a camera counts as frozen when every other one of the episode sees something move meanwhile,
and a single such camera only when it never changes at all.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline.base.config import Params
from pipeline.base.issue import Issue
from pipeline.data import CameraStream
from pipeline.data.timeline import last_at
from pipeline.look.page.blocks import Block, Text
from pipeline.look.page.style import draw_frame, panels
from pipeline.look.recording.episode import BROKEN, Draw, EpisodeView, runs

MOST_FRAMES, RUNS = 120, 12
# Standard deviation of the colour that varies most, of 255, up to which a frame shows nothing.
ONE_COLOUR = 2.0
# Equal pairs in a row that are a freeze of a camera with noise, and the share of all pairs from
# which single ones are told.
DUPLICATES, DUPLICATE_SHARE = 3, 0.1
# Equal pairs in a row, and how many differing ones every other view has meanwhile, that are a
# freeze where pictures have no noise.
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

    And an issue `unreadable` for each view that is left out because a frame of it cannot be read,
    also one that `find_frame_issues` did not find: a file may vanish after it was looked at.
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


@dataclass(frozen=True)
class _Looked:
    """What was seen of a camera.

    `index` (frame,) are the frames that were compared, `equal` (frame - 1,) says whether one is
    that before; `blank` says by frame whether it shows nothing, of those that were looked at for
    that; `sizes` (height, width) by frame, of those that were decoded or that a VL row sees.
    """

    index: NDArray[np.int64]
    equal: NDArray[np.bool_]
    blank: dict[int, bool]
    noisy: bool
    sizes: dict[int, tuple[int, ...]]


def find_frame_issues(view: EpisodeView) -> Iterator[Issue]:
    """Issues of kind unreadable, frame size, dead camera and duplicate frames."""
    looked: dict[str, _Looked] = {}
    for name, camera in view.cameras.items():
        try:
            looked[name] = _look(view, name, camera)
        except BROKEN as error:
            yield view.issue("unreadable", f"view {name}", str(error), severity="error")
    for name, seen in looked.items():
        yield from _resized(view, name, seen)
        yield from _dead(view, name, seen.blank)
        if not all(seen.blank.values()):
            yield from _duplicates(view, name, looked)


def _shown_at(view: EpisodeView, name: str, ticks: Sequence[int]) -> NDArray[np.int64]:
    line = view.timeline
    assert line is not None
    return last_at(view.cameras[name].time, line.time[list(ticks)], line.slack_s)


def _look(view: EpisodeView, name: str, camera: CameraStream) -> _Looked:
    count, repeats = len(camera.time), camera.repeats()
    sizes: dict[int, tuple[int, ...]] = {}
    blank: dict[int, bool] = {}
    if repeats is not None and view.timeline is not None:
        served = np.unique(view.timeline.frames[name]).tolist()
        if (thumbnails := camera.check(served)) is not None:
            blank = dict(zip(served, map(_is_blank, thumbnails), strict=True))
        if (known := camera.sizes(served)) is not None:
            sizes |= zip(served, map(tuple, known.tolist()), strict=True)
    index = _neighbours(count, MOST_FRAMES if repeats is None else 2 * RUNS)
    wanted, steps = not blank, list[float]()
    before: NDArray[np.uint8] | None = None
    for number, frame in zip(index.tolist(), camera.read(index.tolist()), strict=True):
        sizes[number] = frame.shape[:2]
        if wanted:
            blank[number] = _is_blank(frame)
        if before is not None:
            steps.append(_share_differing(before, frame))
        before = frame
    shares = np.array(steps)
    differing = shares[(shares > 0) & (np.diff(index) == 1)]
    noisy = len(differing) > 0 and float(np.percentile(differing, 10)) > NOISY
    sizes = dict(sorted(sizes.items()))
    if repeats is None:
        return _Looked(index, shares == 0, blank, noisy, sizes)
    noisy = noisy and min(_beside(camera, repeats), default=1.0) > NOISY
    return _Looked(np.arange(count), repeats, blank, noisy, sizes)


def _is_blank(frame: NDArray[np.uint8]) -> bool:
    return bool(frame.std(axis=(0, 1)).max() <= ONE_COLOUR)


def _share_differing(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> float:
    """Share of pixels that differ; all of them where sizes do."""
    return float((before != after).any(axis=2).mean()) if before.shape == after.shape else 1.0


def _beside(camera: CameraStream, equal: NDArray[np.bool_]) -> Iterator[float]:
    """Share of pixels that differ just before and just after the longest runs of equal pairs."""
    for first, last in sorted(runs(equal), key=lambda run: run[0] - run[1])[:RUNS]:
        for place in (first - 1, last):
            if 0 <= place < len(equal):
                yield _share_differing(*camera.read([place, place + 1]))


def _neighbours(frames: int, most: int) -> NDArray[np.int64]:
    """All frames where they are few, else `RUNS` runs of neighbours, evenly spread."""
    if frames <= most:
        return np.arange(frames)
    length = most // RUNS
    starts = np.linspace(0, frames - length, RUNS).astype(np.int64)
    return np.unique(starts[:, None] + np.arange(length))


def _resized(view: EpisodeView, name: str, seen: _Looked) -> Iterator[Issue]:
    """Where a view's frames change in size, in one line."""
    time, sizes = view.cameras[name].time, seen.sizes
    changes = [pair for pair in itertools.pairwise(sizes) if sizes[pair[0]] != sizes[pair[1]]]
    if changes:
        old, new = (f"{sizes[at][1]} x {sizes[at][0]} (frame {at})" for at in changes[0])
        span = float(time[changes[0][1]]), float(time[changes[-1][1]])
        message = f"frames change from {old} to {new}; {len(changes)} changes, expected one size"
        yield view.issue("frame size", f"view {name}", message, *span)


def _dead(view: EpisodeView, name: str, blank: Mapping[int, bool]) -> Iterator[Issue]:
    time, frames = view.cameras[name].time, list(blank)
    issue = partial(view.issue, "dead camera", f"view {name}")
    if frames and all(blank.values()):
        yield issue(f"all {len(frames)} frames looked at are of one colour")
        return
    for first, stop in runs(np.array(list(blank.values()), np.bool_)):
        start, last = frames[first], frames[stop - 1]
        which = f"frames {start} to {last}, {stop - first} of the {len(frames)} looked at"
        yield issue(f"{which}, are of one colour", float(time[start]), float(time[last]))


def _duplicates(view: EpisodeView, name: str, looked: Mapping[str, _Looked]) -> Iterator[Issue]:
    seen, issue = looked[name], partial(view.issue, "duplicate frames", f"view {name}")
    time, pairs = view.cameras[name].time, len(seen.equal)
    if pairs >= STILL_PAIRS and seen.equal.all():
        yield issue(f"all {pairs + 1} frames looked at are one picture; expected a running camera")
        return
    single, dead = seen.equal.copy(), [number for number, blank in seen.blank.items() if blank]
    for first, last in runs(seen.equal):
        start, stop = seen.index[[first, last]].tolist()
        if any(start <= number <= stop for number in dead):  # which is told of by itself
            single[first:last] = False
            continue
        span = float(time[start]), float(time[stop])
        long = last - first >= (DUPLICATES if seen.noisy else STILL_PAIRS)
        if long and (seen.noisy or _others_move(view, name, looked, *span)):
            single[first:last] = False
            why = "elsewhere no frame is that before" if seen.noisy else "other views move"
            yield issue(f"frames {start} to {stop} are one picture; {why}", *span)
    again = time[seen.index[1:][single]]
    if seen.noisy and len(again) >= DUPLICATES and len(again) > DUPLICATE_SHARE * pairs:
        message = f"{len(again)} of {pairs} frames compared are the picture before"
        yield issue(message, *again[[0, -1]].tolist())


def _others_move(
    view: EpisodeView, name: str, looked: Mapping[str, _Looked], start_s: float, stop_s: float
) -> bool:
    """Whether every other camera's pictures change between two instants, and there is another."""
    counts: list[int] = []
    for other in looked.keys() - {name}:
        time = view.cameras[other].time[looked[other].index]
        inside = (time[:-1] >= start_s) & (time[1:] <= stop_s)
        counts.append(int(np.count_nonzero(inside & ~looked[other].equal)))
    return bool(counts) and min(counts) >= MOVING_PAIRS
