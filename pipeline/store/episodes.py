"""Episodes one after the other: the arrays of a store that need no model and no stream.

`episode_arrays` makes them, `read_episodes` reads them.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.documents import shown
from pipeline.store.documents import EpisodeText, store_border
from pipeline.store.schema import POSITIONS, STREAMS

FIELDS = tuple(name for name in EpisodeText.model_fields if name != "group")
"""The entries of an episode in `episode/text`; `group` is there too if it is known."""


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
    """Digest of the content and of everything else that decides its rows."""
    ticks: range
    vl_rows: range
    readings: range
    states: range
    group: str | None = None
    """Name shared by episodes that belong together; None where the recording gives none."""

    @property
    def text(self) -> bytes:
        """Its JSON object in `episode/text`."""
        group = {} if self.group is None else {"group": self.group}
        return _text({name: getattr(self, name) for name in FIELDS} | group)

    @property
    def counts(self) -> dict[str, int]:
        """Rows by stream, and bytes of `text`."""
        rows = {name: len(getattr(self, stream.rows)) for name, stream in STREAMS.items()}
        return {**rows, "text": len(self.text)}


def _text(fields: Mapping[str, str]) -> bytes:
    return json.dumps(fields, ensure_ascii=False).encode()


def read_texts(root: Path, arrays: Mapping[str, NDArray[Any]]) -> list[EpisodeText]:
    """The texts of all episodes, in order.

    Raises `StoreIncomplete`, which names the episode whose text is broken.
    """
    text, border = arrays["episode/text"].tobytes(), store_border(root)
    return [
        border.parse_json(text[start:stop], EpisodeText, f"{root}/episode/text, episode {index}")
        for index, (start, stop) in enumerate(pairwise(arrays["episode/text_start"].tolist()))
    ]


def check_index(root: Path, arrays: Mapping[str, NDArray[Any]], rows: Mapping[str, int]) -> None:
    """Raise `StoreIncomplete` where the episodes do not divide the `rows` of each stream."""
    for stream, count in rows.items():
        name = f"episode/{stream}_start"
        edges = arrays[name]
        rising = (edges[1:] >= edges[:-1]).all()
        if not (rising and edges[0] == 0 and edges[-1] == count):
            what = f"expected offsets that rise from 0 to {count}, found {shown(edges.tolist())}"
            raise store_border(root).refusal(root / name, what)


def check_positions(root: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raise `StoreIncomplete` where a tick points at a row outside its episode."""
    starts = arrays["episode/tick_start"]
    episodes = np.flatnonzero(starts[1:] > starts[:-1])
    for name, stream in POSITIONS.items() if len(episodes) else ():
        low = np.minimum.reduceat(arrays[name], starts[episodes])
        high = np.maximum.reduceat(arrays[name], starts[episodes])
        edges = arrays[f"episode/{stream}_start"]
        begin, end = edges[episodes], edges[episodes + 1] - (name == "tick/vl_row")
        for at in np.flatnonzero((low < begin) | (high > end))[:1]:
            what = f"expected positions from {begin[at]} to {end[at]} in episode {episodes[at]}"
            actual = f"{low[at]} to {high[at]}"
            raise store_border(root).refusal(root / name, f"{what}, found {actual}")


def read_episodes(
    root: Path, arrays: Mapping[str, NDArray[Any]], sources: Sequence[str]
) -> tuple[Episode, ...]:
    """All episodes of a store with these arrays, in order; `episode/source` indexes `sources`.

    Raises `StoreIncomplete` where an episode's text is broken, or its source is not one of these.
    """
    source_of = arrays["episode/source"]
    if ((source_of < 0) | (source_of >= len(sources))).any():
        what = f"expected positions below {len(sources)}, the number of sources"
        actual = f"{source_of.min()} to {source_of.max()}"
        raise store_border(root).refusal(root / "episode/source", f"{what}, found {actual}")
    edges = {stream: arrays[f"episode/{stream}_start"].tolist() for stream in STREAMS}
    return tuple(
        Episode(
            index=index,
            source=sources[int(source)],
            **{
                STREAMS[stream].rows: range(edge[index], edge[index + 1])
                for stream, edge in edges.items()
            },
            **dict(text),
        )
        for index, (source, text) in enumerate(
            zip(source_of, read_texts(root, arrays), strict=True)
        )
    )


@dataclass(frozen=True)
class EpisodeRows:
    """How many rows of each stream an episode has, and its entries in `episode/text`."""

    ticks: Any
    """A `pipeline.data.timeline.Timeline`, or an object with the same fields: ticks with indices
    into the episode's own streams."""
    readings: int
    states: int
    source: str
    fields: Mapping[str, str]
    """The entries in `FIELDS`, and `group` where the recording names one."""

    @property
    def text(self) -> bytes:
        """Its JSON object in `episode/text`."""
        return _text(self.fields)

    @property
    def counts(self) -> dict[str, int]:
        """Rows by stream, and bytes of `text`."""
        rows = (len(self.ticks.time), len(self.ticks.vl_time), self.readings, self.states)
        return {**dict(zip(STREAMS, rows, strict=True)), "text": len(self.text)}


def index_arrays(
    episodes: Sequence[Episode | EpisodeRows], sources: Sequence[str]
) -> dict[str, NDArray[Any]]:
    """All arrays under `episode/`; the rows of these episodes follow one another."""
    counts = [episode.counts for episode in episodes]
    arrays: dict[str, NDArray[Any]] = {
        f"episode/{stream}_start": np.cumsum([0, *(count[stream] for count in counts)])
        for stream in (*STREAMS, "text")
    }
    return arrays | {
        "episode/source": np.array([sources.index(episode.source) for episode in episodes], "i4"),
        "episode/text": np.frombuffer(b"".join(episode.text for episode in episodes), np.uint8),
    }


def episode_arrays(
    episodes: Sequence[EpisodeRows], sources: Sequence[str], views: Sequence[str]
) -> dict[str, NDArray[Any]]:
    """All arrays of `tick/` and `episode/`, and the times of `vl/`; with store-global indices."""
    arrays = index_arrays(episodes, sources)
    ticks = [episode.ticks for episode in episodes]
    for stream, stored in STREAMS.items():
        if name := stored.counted_by:
            own = [getattr(tick, name.removeprefix("tick/")) for tick in ticks]
            pairs = zip(own, arrays[f"episode/{stream}_start"][:-1], strict=True)
            arrays[name] = np.concatenate([positions + start for positions, start in pairs])
    return arrays | {
        "tick/time": np.concatenate([tick.time for tick in ticks]),
        "tick/action": np.concatenate([tick.action for tick in ticks]),
        "vl/time": np.concatenate([tick.vl_time for tick in ticks]),
        "vl/frame_time": np.concatenate([tick.frame_times(views) for tick in ticks]),
    }


def episode_of(arrays: Mapping[str, NDArray[Any]], ticks: NDArray[np.int64]) -> NDArray[np.int64]:
    """The index of the episode of each of these store-global ticks."""
    return np.searchsorted(arrays["episode/tick_start"], ticks, side="right") - 1
