"""Pictures at chosen ticks."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.data.timeline import last_at
from pipeline.look.recording.episodes import BROKEN
from pipeline.look.recording.facts import EpisodeView, Flaw


def spread_ticks(view: EpisodeView, count: int) -> list[int]:
    """At most `count` different ticks, evenly from the first to the last; none without ticks."""
    if view.timeline is None:
        return []
    return np.unique(
        np.linspace(0, len(view.timeline.time) - 1, count).round().astype(int)
    ).tolist()


def frames_at(view: EpisodeView, ticks: Sequence[int]) -> dict[str, list[NDArray[np.uint8]]]:
    """By view, the last frame (height, width, 3) RGB at or before each of these ticks.

    Ticks never decrease. A view of which a frame cannot be read is left out (`read_frames` says
    why), and so is every view of an episode without ticks.
    """
    return read_frames(view, ticks)[0]


def read_frames(
    view: EpisodeView, ticks: Sequence[int]
) -> tuple[dict[str, list[NDArray[np.uint8]]], tuple[Flaw, ...]]:
    """`frames_at`, and a flaw `unreadable` for each view that is left out of it.

    Also one that `find_flaws` did not find: a file may vanish after it was looked at.
    """
    if view.timeline is None:
        return {}, ()
    times, slack_s = view.timeline.time[np.asarray(ticks, np.int64)], view.timeline.slack_s
    found: dict[str, list[NDArray[np.uint8]]] = {}
    broken: list[Flaw] = []
    for name, camera in view.cameras.items():
        try:
            found[name] = list(camera.read(last_at(camera.time, times, slack_s).tolist()))
        except BROKEN as error:
            broken.append(view.flaw("unreadable", f"view {name}", str(error), severity="error"))
    return found, tuple(broken)
