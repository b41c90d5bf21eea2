"""The store behind a data set: a checked one on disk, or recordings laid out in memory as one.

A store in memory has frames instead of features, so `gather` cuts the windows of both.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.differences import describe, differences
from pipeline.base.errors import StoreMismatch
from pipeline.data import Recording
from pipeline.data.episode import Frames, ReadEpisode, RowFrames, common_embodiment
from pipeline.data.recording import absolute
from pipeline.data.timeline import tick_hz
from pipeline.store import KEY_BYTES, SCHEMA, Episode, FeatureStore
from pipeline.store.episodes import EpisodeRows, episode_arrays


def check_store(
    store: FeatureStore, vlm_reuse_count: int, action_hz: float | None, action_rotation: str
) -> None:
    """Raise `StoreMismatch` if a store has other ticks than these settings request.

    An `action_hz` of None accepts any rate; `action_rotation` auto accepts any kind of rotation.
    """
    names = store.streams["action"]["names"]
    rotation = "rotvec" if "rx" in names else "euler_delta" if "da" in names else "neither"
    settings = {
        "vlm_reuse_count": (vlm_reuse_count, store.vlm_reuse_count),
        "action_hz": (action_hz, store.action_hz),
        "action_rotation": (action_rotation, rotation),
    }
    asked = {name: pair for name, pair in settings.items() if pair[0] not in (None, "auto")}
    expected, actual = ({name: pair[i] for name, pair in asked.items()} for i in (0, 1))
    if wrong := describe(differences(expected, actual), " expected, found "):
        raise StoreMismatch(
            f"{store.path}: its ticks are not those asked for ({'; '.join(wrong)}). Ask for what "
            "the store has, or set these in params.yaml's data and run stages.extract again."
        )


def episodes_of_format(store: FeatureStore, format: str) -> list[Episode]:
    """The episodes of the store that were recorded in this format; with `auto` all of them.

    Raises `StoreMismatch` where there is none.
    """
    episodes = [episode for episode in store.episodes if format in ("auto", episode.format)]
    if not episodes:
        formats = ", ".join(sorted({episode.format for episode in store.episodes})) or "none"
        raise StoreMismatch(
            f"{store.path}: expected episodes of the format {format!r}, found {formats}. Name "
            "another, or add such recordings to data.sources and run stages.extract again."
        )
    return episodes


def episodes_of_recordings(store: FeatureStore, recordings: Sequence[Recording]) -> list[Episode]:
    """The store's episode of each recording, in their order, under the recording's source.

    An episode is found by format, name and path: the store has paths relative to data.root. Raises
    `StoreMismatch` that names the recordings that the store does not have.
    """
    by_name = defaultdict[tuple[str, str], list[Episode]](list)
    for episode in store.episodes:
        by_name[episode.format, _name(episode.id)].append(episode)
    episodes: dict[int, Episode] = {}
    absent: list[Path] = []
    for recording in recordings:
        alike = by_name[recording.format, _name(recording.id)]
        same = [episode for episode in alike if _same_place(episode.path, recording.path)]
        episodes |= {e.index: replace(e, source=recording.source) for e in same}
        absent += [] if same else [recording.path]
    if absent:
        raise StoreMismatch(
            f"{store.path}: expected features of {len(recordings)} recordings, {len(absent)} of "
            f"them are not in it; first: {absent[0]}. Add them to data.sources and run "
            "stages.extract, or leave the store out to see frames."
        )
    return list(episodes.values())


def store_in_memory(
    episodes: Sequence[ReadEpisode], action_hz: float | None, vlm_reuse_count: int
) -> tuple[FeatureStore, RowFrames]:
    """These episodes as a store whose VL rows have no slots, and the rows' frames.

    It is not on disk: unpickling a data set reads the recordings again. Raises `StoreMismatch` if
    two recordings are not of one embodiment.
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
    arrays = episode_arrays([_episode_rows(episode) for episode in episodes], sources, views)
    rows = len(arrays["vl/time"])
    arrays |= {
        "vl/features": np.zeros((rows, 0, 0), np.float32),
        "vl/slot_valid": np.zeros((rows, 0), np.uint8),
        "vl/key": np.arange(2 * rows).view(np.uint8).reshape(rows, KEY_BYTES),
    }
    for name in ("sensor", "state"):
        streams = [stream for episode in episodes if (stream := getattr(episode, name))]
        empty = np.zeros((0, len(getattr(embodiment, name).names)), np.float32)
        arrays[f"{name}/values"] = np.concatenate([empty, *(s.values for s in streams)])
        arrays[f"{name}/time"] = np.concatenate([np.zeros(0), *(s.time for s in streams)])
    starts, times = arrays["episode/vl_start"], arrays["vl/frame_time"]
    store = FeatureStore(Path(recordings[0].path), attrs, arrays)
    return store, RowFrames(recordings, starts, times, views, len(recordings))


def read_frames(frames: RowFrames, rows: NDArray[np.int64]) -> dict[int, Frames]:
    """The frames of each of these rows; each distinct row is decoded once.

    Raises `RecordingError`, naming the file, if one cannot be decoded.
    """
    ranges = frames.ranges(np.unique(rows))
    return {row: views for part in ranges for row, views in part.read()}


def _name(id: str) -> str:
    """An episode's id without the parent folders that distinguish it within its source."""
    return id.rpartition("/")[2]


def _same_place(stored: str, path: Path) -> bool:
    parts = tuple(part for part in PurePath(stored).parts if part != ".")
    return absolute(path).parts[-len(parts) :] == parts if parts else True


def _episode_rows(episode: ReadEpisode) -> EpisodeRows:
    recording = episode.recording
    text = {name: getattr(recording, name) for name in ("id", "format", "instruction")}
    text |= {"path": str(recording.path), "content": "", "digest": ""}
    text |= {} if recording.group is None else {"group": recording.group}
    readings, states = episode.readings, episode.states
    return EpisodeRows(episode.timeline, readings, states, recording.source, text)
