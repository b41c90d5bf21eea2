"""Recordings laid out in memory as a store is on disk, but with frames in the place of features.

So the store's own `gather` cuts the windows of both.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.data.episode import ReadEpisode, common_embodiment
from pipeline.data.row_range import Frames, RowFrames
from pipeline.data.timeline import tick_hz
from pipeline.store import KEY_BYTES, SCHEMA, FeatureStore
from pipeline.store.episodes import EpisodeRows, episode_arrays


def in_memory(
    episodes: Sequence[ReadEpisode], action_hz: float | None, vlm_reuse_count: int
) -> tuple[FeatureStore, RowFrames]:
    """These episodes as a store whose VL rows have no slots and no keys, and what its rows see.

    It cannot be reopened from disk: whoever pickles it has to read the recordings again. Raises
    `StoreMismatch` where two recordings are not of one embodiment.
    """
    recordings = [episode.recording for episode in episodes]
    embodiment = common_embodiment(
        [(episode.recording, episode.embodiment) for episode in episodes],
        "data set",
        "Make two data sets, or name the action_rotation that both can have",
    )
    sources = list(dict.fromkeys(recording.source for recording in recordings))
    views = sorted({view for episode in episodes for view in episode.timeline.frames})
    attrs: dict[str, Any] = {
        "schema": SCHEMA,
        "feature_spec": {},
        "slots": [],
        "sources": sources,
        "streams": embodiment.document() | {"views": views},
        "action_hz": tick_hz((e.timeline.recorded_hz for e in episodes), action_hz),
        "vlm_reuse_count": vlm_reuse_count,
        "environment": [],
    }
    arrays = episode_arrays([_rows(episode) for episode in episodes], sources, views)
    rows = len(arrays["vl/time"])
    arrays |= {
        "vl/features": np.zeros((rows, 0, 0), np.float32),
        "vl/slot_valid": np.zeros((rows, 0), np.uint8),
        "vl/key": np.zeros((rows, KEY_BYTES), np.uint8),
    }
    for name in ("sensor", "state"):
        streams = [stream for episode in episodes if (stream := getattr(episode, name))]
        empty = np.zeros((0, len(getattr(embodiment, name).names)), np.float32)
        arrays[f"{name}/values"] = np.concatenate([empty, *(s.values for s in streams)])
        arrays[f"{name}/time"] = np.concatenate([np.zeros(0), *(s.time for s in streams)])
    starts, times = arrays["episode/vl_start"], arrays["vl/frame_time"]
    store = FeatureStore(Path(recordings[0].path), attrs, arrays)
    return store, RowFrames(recordings, starts, times, views, len(recordings))


def _rows(episode: ReadEpisode) -> EpisodeRows:
    """What a store without features has of it."""
    recording = episode.recording
    text = {name: getattr(recording, name) for name in ("id", "format", "instruction")}
    text |= {"path": str(recording.path), "content": "", "digest": ""}
    text |= {} if recording.group is None else {"group": recording.group}
    readings, states = episode.readings, episode.states
    return EpisodeRows(episode.timeline, readings, states, recording.source, text)


def read_frames(frames: RowFrames, rows: NDArray[np.int64]) -> dict[int, Frames]:
    """The frames of each of these rows, every row decoded once.

    Raises `RecordingError` naming the file that cannot be decoded.
    """
    ranges = frames.ranges(np.unique(rows))
    return {row: seen for part in ranges for row, seen in part.read()}


def first_keys(frames: RowFrames) -> NDArray[np.uint8]:
    """(row, 16) a digest of the frames that each episode's first row sees, 0 for other rows.

    So that one recording in two formats is known as one, as it is by the keys of a store.
    """
    keys = np.zeros((len(frames.frame_time), KEY_BYTES), np.uint8)
    firsts = frames.vl_start[:-1][np.diff(frames.vl_start) > 0]
    for row in firsts.tolist():
        hasher = hashlib.blake2b(digest_size=KEY_BYTES)
        for view, frame in sorted(read_frames(frames, np.array([row]))[row].items()):
            hasher.update(f"{view} {frame.shape}".encode() + frame.tobytes())
        keys[row] = np.frombuffer(hasher.digest(), np.uint8)
    return keys
