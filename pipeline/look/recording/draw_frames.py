"""The picture of what the cameras saw."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline.data.timeline import last_at
from pipeline.look.page.style import canvas
from pipeline.look.recording.draw_drawing import centre, words
from pipeline.look.recording.facts import EpisodeView

_COLUMN_IN = 2.3


def camera_views(
    view: EpisodeView,
    ticks: Sequence[int],
    frames: Mapping[str, Sequence[NDArray[np.uint8]]],
) -> Figure:
    """The last frame of each view (row) at each tick (column), and how old it was then.

    `frames` holds, by view, one (height, width, 3) a tick; a view that is not in it, or has fewer,
    leaves its places empty and says so.
    """
    rows = _views(view, frames)
    if view.timeline is None or not len(ticks):
        return words("No ticks, so no instant at which to show the views.")
    if not rows:
        return words("The episode has no camera.")
    time = view.timeline.time[np.asarray(ticks, np.int64)]
    heights = [_COLUMN_IN * _aspect(frames.get(name, ())) + 0.25 for name in rows]
    figure = canvas(_COLUMN_IN * max(len(ticks), 2) + 0.4, sum(heights) + 0.6)
    axes = figure.subplots(
        len(rows), len(ticks), squeeze=False, gridspec_kw={"height_ratios": heights}
    )
    for line, name in zip(axes, rows, strict=True):
        ages = _ages(view, name, time)
        for column, axis in enumerate(line):
            _frame(axis, frames.get(name, ()), column, ages)
        line[0].set_ylabel(name)
    for axis, tick, at in zip(axes[0], ticks, time - view.zero, strict=True):
        axis.set_title(f"tick {tick}, {at:.2f} s", fontsize=10)
    return figure


def _frame(
    axis: Axes,
    frames: Sequence[NDArray[np.uint8]],
    column: int,
    ages: NDArray[np.float64] | None,
) -> None:
    axis.set(xticks=[], yticks=[])
    axis.grid(visible=False)
    if column >= len(frames) or ages is None:
        centre(axis, "no frame")
        return
    axis.imshow(frames[column])
    axis.set_xlabel(f"{1000 * ages[column]:.0f} ms old", fontsize=8, labelpad=2)
    axis.spines[:].set_visible(False)


def _views(view: EpisodeView, frames: Mapping[str, Sequence[NDArray[np.uint8]]]) -> list[str]:
    """Those with frames, and those that could not be read."""
    broken = [
        flaw.stream.removeprefix("view ")
        for flaw in view.flaws
        if flaw.kind == "unreadable" and flaw.stream.startswith("view ")
    ]
    return sorted({*view.cameras, *frames, *broken})


def _ages(view: EpisodeView, name: str, time: NDArray[np.float64]) -> NDArray[np.float64] | None:
    camera = view.cameras.get(name)
    if camera is None:
        return None
    slack_s = 0.0 if view.timeline is None else view.timeline.slack_s
    return time - camera.time[np.maximum(last_at(camera.time, time, slack_s), 0)]


def _aspect(frames: Sequence[NDArray[np.uint8]]) -> float:
    """Height over width; that of a widescreen for what is not there."""
    return frames[0].shape[0] / frames[0].shape[1] if len(frames) else 9 / 16
