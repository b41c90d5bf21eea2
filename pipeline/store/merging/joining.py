"""Which episodes of which stores become one store, and whether they can."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import StoreMismatch
from pipeline.store.episodes import SAID
from pipeline.store.reader import Episode, FeatureStore
from pipeline.store.schema import FEATURES

KINDS = {"tick": "ticks", "vl": "vl_rows", "sensor": "readings", "state": "states"}
"""Kinds of rows that belong to an episode, and what `Episode` calls them."""

_STREAMS = {"sensor": "sensor_channels", "state": "state_dim"}
"""Streams that a store may lack."""


@dataclass(frozen=True)
class Run:
    """Episodes of one input that follow each other there and in the joined store."""

    store: FeatureStore
    first: int
    stop: int
    """Episodes first..stop - 1 of the input."""
    starts: Mapping[str, int]
    """Where their rows of each kind begin in the joined store."""

    def rows(self, kind: str) -> range:
        """Their rows of a kind in the input."""
        edges = self.store.array(f"episode/{kind}_start")
        return range(int(edges[self.first]), int(edges[self.stop]))

    def shift(self, kind: str) -> int:
        """What a row's number grows by."""
        return self.starts[kind] - self.rows(kind).start


@dataclass(frozen=True)
class Joined:
    """The episodes of several stores, one behind the other."""

    stores: tuple[FeatureStore, ...]
    runs: tuple[Run, ...]
    episodes: tuple[Episode, ...]
    """As they will be named; their rows are those in the store that they come from."""
    sources: tuple[str, ...]
    twice: int
    """Episodes left out because an earlier store holds them just so."""
    notes: tuple[str, ...]
    """What the user has to know, a line each."""

    @cached_property
    def edges(self) -> dict[str, NDArray[np.int64]]:
        """(episode + 1,) where each episode's rows of each kind, and its text, begin."""
        counts = {
            kind: [len(getattr(one, name)) for one in self.episodes] for kind, name in KINDS.items()
        }
        counts["text"] = [len(_text(one)) for one in self.episodes]
        return {kind: np.cumsum([0, *each], dtype=np.int64) for kind, each in counts.items()}

    @property
    def text(self) -> NDArray[np.uint8]:
        """What is said of the episodes, as `episode/text` has it."""
        return np.frombuffer(b"".join(map(_text, self.episodes)), np.uint8)

    @property
    def source_indices(self) -> NDArray[np.int32]:
        """(episode,) indices into the sources."""
        return np.array([self.sources.index(one.source) for one in self.episodes], np.int32)

    @property
    def streams(self) -> dict[str, Any]:
        """Names and units of each stream: of those stores that have it."""
        streams = self.stores[0].streams
        for stream in _STREAMS:
            streams[stream] = _having(self.stores, stream)[0].streams[stream]
        return streams


def join(stores: Sequence[FeatureStore]) -> Joined:
    """All episodes in the stores' order, each digest once; `StoreMismatch` where they do not fit.

    Different episodes of one name, as of two places that both call a source `lab`, are named apart
    by their store: `held out` is noted by name.
    """
    check_alike(stores)
    sources = list(dict.fromkeys(name for store in stores for name in store.sources))
    digests: set[str] = set()
    names: dict[tuple[str, str], Path] = {}
    kept: list[Episode] = []
    runs: list[Run] = []
    notes: list[str] = []
    starts = dict.fromkeys(KINDS, 0)
    for store in stores:
        for episode in store.episodes:
            if episode.digest in digests:
                continue
            digests.add(episode.digest)
            named = _named_apart(episode, store.path, names)
            if named.id != episode.id:
                other = names[(episode.source, episode.id)]
                notes.append(
                    f"{episode.source}/{episode.id} is one episode in {other} and another in "
                    f"{store.path}, which is named {named.source}/{named.id}"
                )
            names[(named.source, named.id)] = store.path
            kept.append(named)
            if runs and runs[-1].store is store and runs[-1].stop == episode.index:
                runs[-1] = replace(runs[-1], stop=episode.index + 1)
            else:
                runs.append(Run(store, episode.index, episode.index + 1, dict(starts)))
            for kind, rows in KINDS.items():
                starts[kind] += len(getattr(episode, rows))
    twice = sum(len(store.episodes) for store in stores) - len(kept)
    return Joined(tuple(stores), tuple(runs), tuple(kept), tuple(sources), twice, tuple(notes))


def check_alike(stores: Sequence[FeatureStore]) -> None:
    """Raise `StoreMismatch` that names what differs in spec, embodiment, rate or reuse."""
    first = stores[0]
    for store in stores[1:]:
        lines = _differing("", _form(first), _form(store))
        for stream in _STREAMS:
            lines += _differing(stream, *_streams(stores, store, stream))
        if lines:
            lines.sort(key=_rank)
            raise StoreMismatch(
                f"{first.path} and {store.path} cannot become one store, which has one feature "
                "spec and one embodiment; there they differ (first -> second):\n"
                + "\n".join(f"  {line}" for line in lines)
                + "\nExtract one of them again as the other was, or keep two stores."
            )


def _named_apart(episode: Episode, store: Path, names: Mapping[tuple[str, str], Path]) -> Episode:
    name, number = episode.id, 1
    while (episode.source, name) in names:
        prefix = store.stem if number == 1 else f"{store.stem}-{number}"
        name, number = f"{prefix}/{episode.id}", number + 1
    return replace(episode, id=name)


def _text(episode: Episode) -> bytes:
    said = {name: getattr(episode, name) for name in SAID}
    return json.dumps(said, ensure_ascii=False).encode()


def _form(store: FeatureStore) -> dict[str, Any]:
    """What two stores have to agree on; the spec's digest stands for the entries behind it."""
    features = store.array(FEATURES)
    return {
        "feature spec": store.spec,
        "features": {"row": list(features.shape[1:]), "dtype": features.dtype.name},
        "action": store.streams["action"],
        "views": store.streams["views"],
        "action_hz": store.action_hz,
        "vlm_reuse_count": store.vlm_reuse_count,
    }


def _streams(
    stores: Sequence[FeatureStore], store: FeatureStore, stream: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """A stream of the first store that has it, and of this one; equal where this one lacks it."""
    first = _stream(_having(stores, stream)[0], stream)
    return first, _stream(store, stream) if getattr(store, _STREAMS[stream]) else first


def _stream(store: FeatureStore, stream: str) -> dict[str, Any]:
    dtype = store.array(f"{stream}/values").dtype.name
    return {"dtype": dtype, **store.streams[stream]}


def _having(stores: Sequence[FeatureStore], stream: str) -> list[FeatureStore]:
    return [one for one in stores if getattr(one, _STREAMS[stream])] or list(stores)


def _differing(place: str, a: Any, b: Any) -> list[str]:
    """Readable lines, one for each entry of two JSON documents that differs."""
    if a == b:
        return []
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        if "digest" in a and a["digest"] == b.get("digest"):
            return []
        lines = [
            line
            for key in [*a, *(key for key in b if key not in a)]
            if key != "digest"
            for line in _differing(f"{place}.{key}".lstrip("."), a.get(key), b.get(key))
        ]
        return lines or [f"{place}.digest: {a['digest']} -> {b['digest']}"]
    if isinstance(a, list) and isinstance(b, list) and len(a) != len(b):
        return [f"{place}: {len(a)} entries -> {len(b)} entries"]
    return [f"{place}: {_shown(a)} -> {_shown(b)}"]


def _rank(line: str) -> int:
    """Views and slots first: the example prompt differs where they do."""
    place = line.split(":")[0]
    return 2 if "example_prompt" in place else int("views" not in place and "slots" not in place)


def _shown(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 80 else f"{text[:50]} … {text[-25:]}"
