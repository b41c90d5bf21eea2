"""What looks wrong in the pictures: frames that cannot be decoded or change in size, dead and
frozen cameras.

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
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data import CameraStream
from pipeline.look.recording.episodes import BROKEN
from pipeline.look.recording.facts import EpisodeView, Flaw
from pipeline.look.recording.runs import runs

MOST_FRAMES, RUNS = 120, 12
ONE_COLOUR = 2.0
"""Standard deviation of the colour that varies most, of 255, up to which a frame shows nothing."""
DUPLICATES, DUPLICATE_SHARE = 3, 0.1
"""Equal pairs in a row that are a freeze of a camera with noise, and the share of all pairs from
which single ones are told."""
STILL_PAIRS, MOVING_PAIRS = 5, 20
"""Equal pairs in a row, and how many differing ones every other view has meanwhile, that are a
freeze where pictures have no noise."""
NOISY = 0.3
"""Share of the pixels that differ between neighbours where pictures have noise, at least in nine
of ten pairs."""


@dataclass(frozen=True)
class _Looked:
    """What was seen of a camera."""

    index: NDArray[np.int64]
    """(frame,) numbers of the frames that were compared."""
    equal: NDArray[np.bool_]
    """(frame - 1,) whether a frame is that before."""
    levels: dict[int, tuple[float, float]]
    """`_level` by frame, of those that were looked at for one colour."""
    noisy: bool
    sizes: dict[int, tuple[int, ...]]
    """(height, width) by frame, of those that were decoded or that a VL row sees."""


def pixel_flaws(view: EpisodeView) -> Iterator[Flaw]:
    """Flaws of kind unreadable, frame size, dead camera and duplicate frames."""
    looked: dict[str, _Looked] = {}
    for name, camera in view.cameras.items():
        try:
            looked[name] = _look(view, name, camera)
        except BROKEN as error:
            yield view.flaw("unreadable", f"view {name}", str(error), severity="error")
    for name, seen in looked.items():
        yield from _resized(view, name, seen)
        yield from _dead(view, name, seen)
        if not _blank(seen).all():
            yield from _duplicates(view, name, looked)


def _look(view: EpisodeView, name: str, camera: CameraStream) -> _Looked:
    frames = len(camera.time)
    sizes: dict[int, tuple[int, ...]] = {}
    seen: dict[int, tuple[float, float]] = {}
    repeats = camera.repeats()
    if repeats is not None:
        if view.timeline is not None:
            served = np.unique(view.timeline.frames[name]).tolist()
            if (thumbnails := camera.check(served)) is not None:
                seen = dict(zip(served, map(_level, thumbnails), strict=True))
            if (told := camera.sizes(served)) is not None:
                sizes |= zip(served, map(tuple, told.tolist()), strict=True)
        index = _neighbours(frames, 2 * RUNS)
        compared, equal = np.arange(frames), repeats
    else:
        index = _neighbours(frames, MOST_FRAMES)
        compared, equal = index, np.zeros(max(0, len(index) - 1), np.bool_)
    levels: dict[int, tuple[float, float]] = {}
    differing: list[float] = []
    before: NDArray[np.uint8] | None = None
    for place, frame in enumerate(camera.read(index.tolist())):
        sizes[int(index[place])] = frame.shape[:2]
        if not seen:
            levels[int(index[place])] = _level(frame)
        if before is not None and before.shape == frame.shape:
            differs = float((frame != before).any(axis=2).mean())
            if compared is index:
                equal[place - 1] = differs == 0
            if differs and index[place] == index[place - 1] + 1:
                differing.append(differs)
        before = frame
    noisy = bool(differing) and float(np.percentile(differing, 10)) > NOISY
    if noisy and compared is not index:
        noisy = min(_beside(camera, equal), default=1.0) > NOISY
    return _Looked(compared, equal, seen or levels, noisy, dict(sorted(sizes.items())))


def _level(frame: NDArray[np.uint8]) -> tuple[float, float]:
    """Mean of all values, and the standard deviation of the colour that varies most."""
    return float(frame.mean()), float(frame.std(axis=(0, 1)).max())


def _blank(seen: _Looked) -> NDArray[np.bool_]:
    """(frame looked at,) whether it shows nothing."""
    return np.array([spread <= ONE_COLOUR for _, spread in seen.levels.values()], np.bool_)


def _beside(camera: CameraStream, equal: NDArray[np.bool_]) -> Iterator[float]:
    """Share of pixels that differ just before and just after the longest runs of equal pairs."""
    longest = sorted(runs(equal), key=lambda run: run[0] - run[1])[:RUNS]
    for first, last in longest:
        for place in (first - 1, last):
            if 0 <= place < len(equal):
                before, after = camera.read([place, place + 1])
                alike = before.shape == after.shape
                yield float((before != after).any(axis=2).mean()) if alike else 1.0


def _neighbours(frames: int, most: int) -> NDArray[np.int64]:
    """All frames where they are few, else `RUNS` runs of neighbours, evenly spread."""
    if frames <= most:
        return np.arange(frames)
    length = most // RUNS
    starts = np.linspace(0, frames - length, RUNS).astype(np.int64)
    return np.unique(starts[:, None] + np.arange(length))


def _resized(view: EpisodeView, name: str, seen: _Looked) -> Iterator[Flaw]:
    """Where a view's frames change in size, in one line."""
    time, frames = view.cameras[name].time, list(seen.sizes)
    changes = [
        (before, frame)
        for before, frame in itertools.pairwise(frames)
        if seen.sizes[before] != seen.sizes[frame]
    ]
    if not changes:
        return
    before, frame = changes[0]
    (old_height, old_width), (height, width) = seen.sizes[before], seen.sizes[frame]
    more = f"; {len(changes)} changes in all" if len(changes) > 1 else ""
    yield view.flaw(
        "frame size",
        f"view {name}",
        f"frames change from {old_width} x {old_height} (frame {before}) to {width} x {height} "
        f"(frame {frame}) at {time[frame] - view.zero:.2f} s{more}; expected one size",
        float(time[frame]),
        float(time[changes[-1][1]]),
    )


def _dead(view: EpisodeView, name: str, seen: _Looked) -> Iterator[Flaw]:
    time, frames = view.cameras[name].time, list(seen.levels)
    for first, stop in runs(_blank(seen)):
        dead = frames[first:stop]
        level = float(np.mean([seen.levels[frame][0] for frame in dead]))
        said = f"of one colour (mean {level:.0f} of 255)"
        if len(dead) == len(frames):
            said = f"all {len(frames)} frames looked at are {said}"
            yield view.flaw("dead camera", f"view {name}", f"{said}; expected a picture")
            return
        begin, end = float(time[dead[0]]), float(time[dead[-1]])
        yield view.flaw(
            "dead camera",
            f"view {name}",
            f"{len(dead)} of the {len(frames)} frames looked at are {said}: frames {dead[0]} to "
            f"{dead[-1]}, {begin - view.zero:.2f} to {end - view.zero:.2f} s; expected a picture",
            begin,
            end,
        )


def _duplicates(view: EpisodeView, name: str, looked: Mapping[str, _Looked]) -> Iterator[Flaw]:
    seen = looked[name]
    time, pairs = view.cameras[name].time, len(seen.equal)
    all_seen = len(seen.index) == len(time)
    if pairs and seen.equal.all() and pairs >= STILL_PAIRS:
        yield view.flaw(
            "duplicate frames",
            f"view {name}",
            f"all {len(seen.index)} frames {'' if all_seen else 'looked at '}are one picture; "
            "expected a camera that runs",
        )
        return
    told = np.zeros(pairs, np.bool_)
    for first, last in runs(seen.equal):
        start, stop = (int(seen.index[place]) for place in (first, last))
        frozen = (
            last - first >= DUPLICATES
            if seen.noisy
            else last - first >= STILL_PAIRS
            and _others_move(view, name, looked, float(time[start]), float(time[stop]))
        )
        if frozen:
            told[first:last] = True
            yield view.flaw(
                "duplicate frames",
                f"view {name}",
                f"frames {start} to {stop} are one picture"
                f"{'' if all_seen else ' where they were looked at'}, "
                f"{time[stop] - time[start]:.2f} s from {time[start] - view.zero:.2f} s; "
                + ("elsewhere no frame is that before" if seen.noisy else "other views move"),
                float(time[start]),
                float(time[stop]),
            )
    single = time[seen.index[1:][seen.equal & ~told]]
    if seen.noisy and len(single) >= DUPLICATES and len(single) > DUPLICATE_SHARE * pairs:
        instants = ", ".join(f"{one - view.zero:.2f}" for one in single[:DUPLICATES])
        yield view.flaw(
            "duplicate frames",
            f"view {name}",
            f"{len(single)} of {pairs} frames compared are the picture before, first at "
            f"{instants} s, last at {single[-1] - view.zero:.2f} s; the camera is slower than its "
            "frames are stamped, or frames were stored twice",
            float(single[0]),
            float(single[-1]),
        )


def _others_move(
    view: EpisodeView, name: str, looked: Mapping[str, _Looked], start_s: float, stop_s: float
) -> bool:
    """Whether every other camera's pictures change between two instants, and there is another."""
    others = [other for other in looked if other != name]
    return bool(others) and all(
        _differing(looked[other], view.cameras[other].time, start_s, stop_s) >= MOVING_PAIRS
        for other in others
    )


def _differing(seen: _Looked, time: NDArray[np.float64], start_s: float, stop_s: float) -> int:
    """How many neighbours among the frames compared differ within a span."""
    compared = time[seen.index]
    inside = (compared[:-1] >= start_s) & (compared[1:] <= stop_s)
    return int(np.count_nonzero(inside & ~seen.equal))
