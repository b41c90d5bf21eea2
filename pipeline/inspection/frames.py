"""Pictures at chosen ticks."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import RecordingError
from pipeline.inspection.facts import EpisodeView
from pipeline.timeline import last_at


def spread_ticks(view: EpisodeView, count: int) -> list[int]:
    """At most `count` different ticks, evenly from the first to the last; none without ticks."""
    if view.timeline is None:
        return []
    return np.unique(
        np.linspace(0, len(view.timeline.time) - 1, count).round().astype(int)
    ).tolist()


def frames_at(view: EpisodeView, ticks: Sequence[int]) -> dict[str, list[NDArray[np.uint8]]]:
    """By view, the last frame (height, width, 3) RGB at or before each of these ticks.

    Ticks never decrease. A view of which a frame cannot be decoded is left out (`find_flaws` says
    why), and so is every view of an episode without ticks.
    """
    if view.timeline is None:
        return {}
    times = view.timeline.time[np.asarray(ticks, np.int64)]
    found: dict[str, list[NDArray[np.uint8]]] = {}
    for name, camera in view.cameras.items():
        try:
            found[name] = list(camera.read(last_at(camera.time, times).tolist()))
        except RecordingError:
            continue
    return found
