"""Recordings laid out in memory as a store is on disk, but without features.

So the store's own `gather` cuts the windows of both.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.data import Recording, Stream
from pipeline.data.embodiment import common_embodiment
from pipeline.data.episode import ReadEpisode, read_episode
from pipeline.data.timeline import ActionRotation
from pipeline.store import KEY_BYTES, SCHEMA, FeatureStore
from pipeline.store.episodes import EpisodeRows, episode_arrays


def read_episodes(
    recordings: Sequence[Recording],
    action_hz: float | None,
    vlm_reuse_count: int,
    action_rotation: ActionRotation,
) -> list[ReadEpisode]:
    """Every stream of every recording, and the ticks over it; no frame is decoded.

    Raises `RecordingError` for what cannot be read or has no tick.
    """
    return [
        read_episode(recording, action_hz, vlm_reuse_count, action_rotation)
        for recording in tqdm(recordings, "reading", unit="episode", disable=None, leave=False)
    ]


def in_memory(
    episodes: Sequence[ReadEpisode], action_hz: float | None, vlm_reuse_count: int
) -> FeatureStore:
    """These episodes as a store whose VL rows have no slots and no keys.

    It cannot be reopened from disk: whoever pickles it has to read the recordings again. Raises
    `StoreMismatch` where two recordings are not of one embodiment.
    """
    embodiment = common_embodiment(
        [(one.recording, one.embodiment) for one in episodes],
        "data set",
        "Make two data sets, or name the action_rotation that both can have",
    )
    sources = list(dict.fromkeys(one.recording.source for one in episodes))
    views = sorted({view for one in episodes for view in one.timeline.frames})
    attrs: dict[str, Any] = {
        "schema": SCHEMA,
        "feature_spec": {},
        "slots": [],
        "sources": sources,
        "streams": embodiment.document() | {"views": views},
        "action_hz": action_hz,
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
    arrays |= _joined("sensor", [one.sensor for one in episodes], len(embodiment.sensor.names))
    arrays |= _joined("state", [one.state for one in episodes], len(embodiment.state.names))
    return FeatureStore(Path(episodes[0].recording.path), attrs, arrays)


def _rows(episode: ReadEpisode) -> EpisodeRows:
    """What a store without features has of it."""
    recording = episode.recording
    text = {
        "id": recording.id,
        "path": str(recording.path),
        "format": recording.format,
        "instruction": recording.instruction,
        "content": "",
        "digest": "",
    }
    readings, states = episode.readings, episode.states
    return EpisodeRows(episode.timeline, readings, states, recording.source, text)


def _joined(name: str, streams: Sequence[Stream | None], width: int) -> dict[str, NDArray[Any]]:
    there = [stream for stream in streams if stream is not None]
    empty = np.zeros((0, width), np.float32)
    return {
        f"{name}/values": np.concatenate([empty, *(stream.values for stream in there)]),
        f"{name}/time": np.concatenate([np.zeros(0), *(stream.time for stream in there)]),
    }
