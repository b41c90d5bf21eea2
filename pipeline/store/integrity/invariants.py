"""Do the arrays of a store agree: offsets, indices, clocks and episodes."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.store.chunks import read_rows
from pipeline.store.episodes import SAID
from pipeline.store.integrity.findings import Damage, Places
from pipeline.store.schema import ArraySpec

BLOCK_ROWS = 2**20
CLOCKS = ("tick/time", "vl/time", "sensor/time", "state/time")
_ENDS = {
    "tick": "tick/time",
    "vl": "vl/time",
    "sensor": "sensor/time",
    "state": "state/time",
    "text": "episode/text",
}


class EpisodeTable:
    """The episodes of a store, as far as the arrays that say so are sound."""

    def __init__(
        self,
        root: Path,
        specs: Mapping[str, ArraySpec],
        attrs: Mapping[str, Any],
        unsound: set[str],
    ) -> None:
        self._root = root
        self._specs = {name: spec for name, spec in specs.items() if name not in unsound}
        self._attrs = attrs

    @cached_property
    def edges(self) -> dict[str, NDArray[np.int64]]:
        """(episode + 1,) offsets by kind, those that are what offsets must be."""
        return {kind: edge for kind, edge in self._offsets.items() if not self._wrong(kind, edge)}

    @cached_property
    def said(self) -> list[dict[str, Any] | None]:
        """What is said of each episode; None where it is not a JSON object of the contract."""
        if "text" not in self.edges or "episode/text" not in self._specs:
            return []
        text = self._read("episode/text").tobytes()
        return [_said(text[start:stop]) for start, stop in pairwise(self.edges["text"])]

    @property
    def places(self) -> Places:
        """Names rows by episode and tick."""
        ids = [str(said["id"]) if said else f"number {at}" for at, said in enumerate(self.said)]
        return Places(self.edges, ids, self._reuse)

    def damaged(self) -> Iterator[Damage]:
        """What is wrong with the arrays under `episode/`."""
        for kind, edge in self._offsets.items():
            if what := self._wrong(kind, edge):
                yield self._damage(f"episode/{kind}_start", what)
        for episode, said in enumerate(self.said):
            if said is None:
                what = f"episode {episode}: expected a JSON object with {sorted(SAID)}"
                yield self._damage("episode/text", what)
        if "episode/source" in self._specs:
            sources = self._read("episode/source")
            count = len(self._attrs.get("sources", ()))
            for episode in np.flatnonzero((sources < 0) | (sources >= count)):
                what = f"episode {episode}: source {sources[episode]} of {count}"
                yield self._damage("episode/source", what)

    @property
    def _reuse(self) -> int:
        return int(self._attrs.get("vlm_reuse_count", 1))

    @cached_property
    def _offsets(self) -> dict[str, NDArray[np.int64]]:
        names = {kind: f"episode/{kind}_start" for kind in _ENDS}
        return {kind: self._read(name) for kind, name in names.items() if name in self._specs}

    def _wrong(self, kind: str, edge: NDArray[np.int64]) -> str | None:
        end = self._specs[_ENDS[kind]].shape[0] if _ENDS[kind] in self._specs else edge[-1]
        if edge[0] != 0 or edge[-1] != end:
            return f"expected offsets from 0 to {end}, found {edge[0]} to {edge[-1]}"
        if (back := np.flatnonzero(np.diff(edge) < 0)).size:
            return f"the offsets go back after episode {back[0]}"
        if kind == "vl" and "tick" in self._offsets:
            wanted = -(-np.diff(self._offsets["tick"]) // self._reuse)
            if (off := np.flatnonzero(np.diff(edge) != wanted)).size:
                found = np.diff(edge)[off[0]]
                return f"episode {off[0]}: expected {wanted[off[0]]} VL rows, found {found}"
        return None

    def _damage(self, array: str, what: str) -> Damage:
        return Damage(array, None, self._root / array, what)

    def _read(self, name: str) -> NDArray[Any]:
        return read_rows(self._root, self._specs[name])


@dataclass(frozen=True)
class RelationTask:
    """Check a block of rows of a clock or of the ticks' indices against the episodes' offsets."""

    root: Path
    spec: ArraySpec
    edges: Mapping[str, NDArray[np.int64]]
    reuse: int
    start: int
    stop: int

    @property
    def bytes(self) -> int:
        """That it reads."""
        return (self.stop - self.start) * self.spec.row_bytes

    def __call__(self) -> tuple[str, str, NDArray[np.int64]]:
        """The array, what is wrong, and with which of its rows."""
        if self.spec.name in CLOCKS:
            bad, what = self._backwards(), "the clock goes backwards"
        elif self.spec.name == "tick/vl_row":
            bad, what = self._other_vl_row(), f"not the VL row of its {self.reuse} ticks"
        else:
            bad, what = self._outside(), "not a position in its episode, or before an earlier one"
        return self.spec.name, what, np.flatnonzero(bad) + self.start

    def _backwards(self) -> NDArray[np.bool_]:
        kind = self.spec.name.split("/")[0]
        return self._falls(self.edges[kind])

    def _other_vl_row(self) -> NDArray[np.bool_]:
        tick, episode = self._ticks()
        inside = (tick - self.edges["tick"][episode]) // self.reuse
        return self._values() != self.edges["vl"][episode] + inside

    def _outside(self) -> NDArray[np.bool_]:
        _, episode = self._ticks()
        edge = self.edges[self.spec.name.removeprefix("tick/").removesuffix("_end")]
        values = self._values()
        beyond = (values < edge[episode]) | (values > edge[episode + 1])
        return beyond | self._falls(self.edges["tick"])

    def _falls(self, edges: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Where a value is less than the one before it in the same episode."""
        first = max(0, self.start - 1)
        values = read_rows(self.root, self.spec, first, self.stop)
        falls = np.zeros(len(values), np.bool_)
        falls[1:] = values[1:] < values[:-1]
        starts = edges[(edges >= first) & (edges < self.stop)]
        falls[starts - first] = False
        return falls[self.start - first :]

    def _ticks(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        tick = np.arange(self.start, self.stop)
        return tick, np.searchsorted(self.edges["tick"], tick, side="right") - 1

    def _values(self) -> NDArray[Any]:
        return read_rows(self.root, self.spec, self.start, self.stop)


def relation_tasks(
    root: Path, specs: Mapping[str, ArraySpec], table: EpisodeTable, reuse: int, unsound: set[str]
) -> list[RelationTask]:
    """The blocks of every clock and index array that can be judged."""
    needed: dict[str, set[str]] = {name: {name.split("/")[0]} for name in CLOCKS}
    needed |= {
        "tick/vl_row": {"tick", "vl"},
        "tick/sensor_end": {"tick", "sensor"},
        "tick/state_end": {"tick", "state"},
    }
    return [
        RelationTask(
            root,
            specs[name],
            {kind: table.edges[kind] for kind in kinds},
            reuse,
            start,
            min(start + BLOCK_ROWS, specs[name].shape[0]),
        )
        for name, kinds in needed.items()
        if name in specs and name not in unsound and kinds <= set(table.edges)
        for start in range(0, specs[name].shape[0], BLOCK_ROWS)
    ]


def _said(text: bytes) -> dict[str, Any] | None:
    try:
        said = json.loads(text)
    except ValueError:
        return None
    return said if isinstance(said, dict) and set(said) >= set(SAID) else None
