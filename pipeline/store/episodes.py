"""Episodes one behind the other: the arrays of a store that need no model and no stream.

`episode_arrays` makes them, `read_episodes` says what they hold.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

SAID = ("id", "path", "format", "instruction", "content", "digest")
"""What `episode/text` says of each episode."""


@dataclass(frozen=True)
class Episode:
    """One episode and the rows of each array that belong to it."""

    index: int
    id: str
    source: str
    path: str
    format: str
    instruction: str
    content: str
    """Digest of its files."""
    digest: str
    """Digest of its content and of everything else that decides its rows."""
    ticks: range
    vl_rows: range
    readings: range
    states: range


def read_episodes(
    arrays: Mapping[str, NDArray[Any]], sources: Sequence[str]
) -> tuple[Episode, ...]:
    """All episodes of a store with these arrays, in order; `sources` as `episode/source` counts."""
    edges = {
        kind: arrays[f"episode/{kind}_start"].tolist()
        for kind in ("tick", "vl", "sensor", "state", "text")
    }
    text = arrays["episode/text"].tobytes()
    found: list[Episode] = []
    for index, source in enumerate(arrays["episode/source"]):
        rows = {kind: range(edge[index], edge[index + 1]) for kind, edge in edges.items()}
        said = json.loads(text[rows["text"].start : rows["text"].stop])
        found.append(
            Episode(
                index=index,
                source=sources[int(source)],
                ticks=rows["tick"],
                vl_rows=rows["vl"],
                readings=rows["sensor"],
                states=rows["state"],
                **said,
            )
        )
    return tuple(found)


class Ticks(Protocol):
    """An episode's ticks, with indices into its own streams: `pipeline.data.timeline.Timeline`."""

    @property
    def time(self) -> NDArray[np.float64]: ...
    @property
    def action(self) -> NDArray[np.float32]: ...
    @property
    def vl_row(self) -> NDArray[np.int64]: ...
    @property
    def vl_time(self) -> NDArray[np.float64]: ...
    @property
    def sensor_end(self) -> NDArray[np.int64]: ...
    @property
    def state_end(self) -> NDArray[np.int64]: ...

    def frame_times(self, views: Sequence[str]) -> NDArray[np.float64]: ...


@dataclass(frozen=True)
class EpisodeRows:
    """How many rows of each kind an episode has, and what is said of it."""

    ticks: Ticks
    readings: int
    states: int
    source: str
    said: Mapping[str, str]
    """The fields named in `SAID`."""

    @property
    def text(self) -> bytes:
        """What is said, as JSON."""
        return json.dumps(self.said, ensure_ascii=False).encode()


def episode_edges(episodes: Sequence[EpisodeRows]) -> dict[str, NDArray[np.int64]]:
    """(episode + 1,) where the ticks, VL rows, readings, states and text of each begin."""
    counts = {
        "tick": [len(one.ticks.time) for one in episodes],
        "vl": [len(one.ticks.vl_time) for one in episodes],
        "sensor": [one.readings for one in episodes],
        "state": [one.states for one in episodes],
        "text": [len(one.text) for one in episodes],
    }
    return {kind: np.cumsum([0, *each], dtype=np.int64) for kind, each in counts.items()}


def episode_arrays(
    episodes: Sequence[EpisodeRows], sources: Sequence[str], views: Sequence[str]
) -> dict[str, NDArray[Any]]:
    """Everything under `tick/` and `episode/`, and the times under `vl/`; indices store-global."""
    edges = episode_edges(episodes)
    ticks = [one.ticks for one in episodes]

    def shifted(kind: str, values: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
        starts = edges[kind][:-1]
        return np.concatenate([one + start for one, start in zip(values, starts, strict=True)])

    arrays = {
        "tick/time": np.concatenate([one.time for one in ticks]),
        "tick/action": np.concatenate([one.action for one in ticks]),
        "tick/vl_row": shifted("vl", [one.vl_row for one in ticks]),
        "tick/sensor_end": shifted("sensor", [one.sensor_end for one in ticks]),
        "tick/state_end": shifted("state", [one.state_end for one in ticks]),
        "vl/time": np.concatenate([one.vl_time for one in ticks]),
        "vl/frame_time": np.concatenate([one.frame_times(views) for one in ticks]),
        "episode/source": np.array([sources.index(one.source) for one in episodes], np.int32),
        "episode/text": np.frombuffer(b"".join(one.text for one in episodes), np.uint8),
    }
    return arrays | {f"episode/{kind}_start": edge for kind, edge in edges.items()}


def episode_of(arrays: Mapping[str, NDArray[Any]], ticks: NDArray[np.int64]) -> NDArray[np.int64]:
    """The index of the episode of each of these store-global ticks."""
    return np.searchsorted(arrays["episode/tick_start"], ticks, side="right") - 1
