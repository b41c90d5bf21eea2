"""Frames of the recordings that an evaluation's episodes are from, for its page.

A store holds no frames. It holds the path and file digests of each episode's recording, and the
capture times of each VL row's frames.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.base.digests import file_digest
from pipeline.base.errors import RecordingError
from pipeline.data import Recording, content_digest, open_recording
from pipeline.data.episode import RowRange
from pipeline.store import Episode, FeatureStore
from pipeline.train.batches import Ticks, evenly

Frame = NDArray[np.uint8]


@dataclass(frozen=True)
class EpisodeFrames:
    """Frames of one episode, or why there are none."""

    frames: Mapping[str, Sequence[Frame]]
    """By view, one for each requested VL row: (height, width, 3), RGB."""
    absence: str = ""
    """If there are no frames, one sentence that names the path."""


def shown_ticks(store: FeatureStore, ticks: Ticks, count: int) -> Ticks:
    """At most `count` of these ticks of one episode, evenly spread.

    If there are ticks at which a VL row begins, only these are taken: their frames are the newest.
    """
    rows = store.array("tick/vl_row")[ticks]
    before = store.array("tick/vl_row")[np.maximum(ticks - 1, 0)]
    fresh = ticks[(rows != before) | (ticks == 0)]
    return evenly(fresh if len(fresh) else ticks, count)


def read_episode_frames(
    store: FeatureStore,
    episode: Episode,
    vl_rows: Sequence[int],
    root: Path,
) -> EpisodeFrames:
    """The frames of these store-global VL rows of one episode, ascending.

    Relative paths in the store are under `root`. A recording gives no frame if the digests of its
    files have changed; for them each file is read whole.
    """
    path = root / episode.path
    if not path.is_dir():
        return EpisodeFrames({}, f"No frames: there is no recording at {path} any more.")
    try:
        recording = _open_recording(store, episode, path)
        if recording is None:
            return EpisodeFrames(
                {}, f"No frames: the recording at {path} changed since the store was made from it."
            )
        rows = np.asarray(vl_rows, np.int64)
        times = store.array("vl/frame_time")[rows]
        shown = RowRange.of(recording, recording.cameras(), rows, times, store.spec["views"])
        frames = [frames for _, frames in shown.read()]
        return EpisodeFrames({view: [by_view[view] for by_view in frames] for view in shown.frames})
    except (RecordingError, OSError) as error:
        reason = " ".join(str(error).split())
        return EpisodeFrames({}, f"No frames: the recording at {path} cannot be read ({reason}).")


def _open_recording(store: FeatureStore, episode: Episode, path: Path) -> Recording | None:
    """The episode's recording, with all views or those of the store; None where it has changed."""
    for views in (None, store.spec["views"]):
        recording = open_recording(path, episode.format, episode.id, views)
        if content_digest(recording, file_digest) == episode.content:
            return recording
    return None
