"""Recordings laid out in memory as a store is on disk, but without features.

So the store's own `gather` cuts the windows of both.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.data import Recording, Stream
from pipeline.data.embodiment import Embodiment, common_embodiment
from pipeline.data.timeline import ActionRotation, Timeline, build_timeline
from pipeline.store import KEY_BYTES, SCHEMA, FeatureStore
from pipeline.store.episodes import EpisodeRows, episode_arrays


@dataclass(frozen=True)
class ReadEpisode:
    """A recording, its ticks and its whole streams."""

    recording: Recording
    timeline: Timeline
    sensor: Stream | None
    state: Stream | None

    @property
    def embodiment(self) -> Embodiment:
        """What its channels are."""
        line = self.timeline
        return Embodiment.of(line.action_channels, line.action_kind, self.sensor, self.state)

    @property
    def rows(self) -> EpisodeRows:
        """What a store without features has of it."""
        one = self.recording
        said = {
            "id": one.id,
            "path": str(one.path),
            "format": one.format,
            "instruction": one.instruction,
            "content": "",
            "digest": "",
        }
        readings, states = (
            0 if each is None else len(each.time) for each in (self.sensor, self.state)
        )
        return EpisodeRows(self.timeline, readings, states, one.source, said)


def read_episodes(
    recordings: Sequence[Recording],
    action_hz: float | None,
    vlm_reuse_count: int,
    action_rotation: ActionRotation,
) -> list[ReadEpisode]:
    """Every stream of every recording, and the ticks over it; no frame is decoded.

    Raises `RecordingError` for what cannot be read or has no tick.
    """
    episodes: list[ReadEpisode] = []
    for recording in tqdm(recordings, "reading", unit="episode", disable=None, leave=False):
        sensor, state = recording.sensor(), recording.state()
        line = build_timeline(recording, action_hz, vlm_reuse_count, action_rotation, state, sensor)
        episodes.append(ReadEpisode(recording, line, sensor, state))
    return episodes


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
    arrays = episode_arrays([one.rows for one in episodes], sources, views)
    rows = len(arrays["vl/time"])
    arrays |= {
        "vl/features": np.zeros((rows, 0, 0), np.float32),
        "vl/slot_valid": np.zeros((rows, 0), np.uint8),
        "vl/key": np.zeros((rows, KEY_BYTES), np.uint8),
    }
    arrays |= _joined("sensor", [one.sensor for one in episodes], len(embodiment.sensor.names))
    arrays |= _joined("state", [one.state for one in episodes], len(embodiment.state.names))
    return FeatureStore(Path(episodes[0].recording.path), attrs, arrays)


def _joined(name: str, streams: Sequence[Stream | None], width: int) -> dict[str, NDArray[Any]]:
    there = [stream for stream in streams if stream is not None]
    empty = np.zeros((0, width), np.float32)
    return {
        f"{name}/values": np.concatenate([empty, *(stream.values for stream in there)]),
        f"{name}/time": np.concatenate([np.zeros(0), *(stream.time for stream in there)]),
    }
