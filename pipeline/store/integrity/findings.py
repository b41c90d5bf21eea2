"""What a check of a store found, for programs and for people."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.store.replacement import Inode

MOST_LINES = 20
"""Of one kind that are shown; the rest is counted."""


@dataclass(frozen=True)
class Damage:
    """One thing that is wrong with an array other than a feature row of it."""

    array: str
    """Name of the array; empty for the store's own metadata."""
    chunk: int | None
    """None where it is the metadata of the array."""
    file: Path
    what: str
    """Expected and found, with the rows that it touches."""


class Places:
    """Says which episode and tick a row of an array belongs to."""

    def __init__(
        self, edges: Mapping[str, NDArray[np.int64]], ids: Sequence[str], reuse: int
    ) -> None:
        self._edges = edges
        self._ids = ids
        self._reuse = reuse

    def of(self, kind: str, row: int) -> str:
        """` (episode 'x', tick 12)` of a `tick` or `vl` row, ` (episode 'x')` of a reading.

        The tick is store-global. Empty where the store's own episode table cannot tell.
        """
        edges = self._edges.get(kind)
        if edges is None:
            return ""
        episode = int(np.searchsorted(edges, row, side="right")) - 1
        if not 0 <= episode < len(self._ids):
            return ""
        said = f" (episode {self._ids[episode]!r}"
        if kind == "tick":
            return f"{said}, tick {row})"
        if kind == "vl" and "tick" in self._edges:
            tick = int(self._edges["tick"][episode]) + (row - int(edges[episode])) * self._reuse
            return f"{said}, tick {tick})"
        return f"{said})"


@dataclass(frozen=True)
class Findings:
    """What was checked of a store and everything that is wrong with it."""

    store: Path
    rows: int
    """Feature rows whose checksums were compared."""
    bytes: int
    """Read and checked."""
    seconds: float
    inode: Inode | None = None
    """Of the store that was checked: another may have taken its place since."""
    damaged: tuple[Damage, ...] = ()
    """Arrays and chunk files."""
    problems: tuple[str, ...] = ()
    """What belongs to no array, such as files that have no place in a store."""
    faults: Mapping[str, NDArray[np.int64]] = field(default_factory=dict[str, NDArray[np.int64]])
    """The feature rows that cannot be used, ascending, by what is wrong with them."""
    places: Places = field(default_factory=lambda: Places({}, (), 1))

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not (self.faults or self.damaged or self.problems)

    @property
    def bad_rows(self) -> NDArray[np.int64]:
        """The VL rows whose features cannot be used, ascending."""
        return np.unique(np.concatenate([np.zeros(0, np.int64), *self.faults.values()]))

    def damaged_arrays(self) -> set[str]:
        """Names of the arrays that something is wrong with, bad feature rows apart."""
        return {one.array for one in self.damaged}

    def damaged_chunks(self, array: str) -> set[int]:
        """Chunks of an array that something is wrong with."""
        return {one.chunk for one in self.damaged if one.array == array and one.chunk is not None}

    def lines(self) -> list[str]:
        """For people: everything that is wrong, long lists capped."""
        return [
            *capped([f"{one.file}: {one.what}" for one in self.damaged], "damaged places"),
            *(line for what, rows in self.faults.items() for line in self._named(rows, what)),
            *capped(list(self.problems), "problems"),
        ]

    def _named(self, rows: NDArray[np.int64], what: str) -> list[str]:
        lines = [f"VL row {row}{self.places.of('vl', row)}: {what}" for row in rows[:MOST_LINES]]
        more = len(rows) - len(lines)
        return [*lines, *([f"and {more} more VL rows: {what}"] if more else [])]

    def advice(self) -> str:
        """For people: what to run next."""
        if self.problems and not (self.damaged or self.faults):
            return "All that was stored is sound: look at these files and remove them."
        return "Run python -m stages.verify --repair, then python -m stages.extract."

    def summary(self) -> str:
        """For people: how much was checked, how fast."""
        rate = self.bytes / 1e9 / self.seconds if self.seconds else 0.0
        return (
            f"{self.store}: checked {self.rows} feature rows and {self.bytes / 2**20:.1f} MiB in "
            f"{self.seconds:.1f} s ({rate:.2f} GB/s)"
        )


def capped(lines: Sequence[str], kind: str) -> list[str]:
    """The first lines, and how many more there are."""
    more = len(lines) - MOST_LINES
    return [*lines[:MOST_LINES], *([f"and {more} more {kind}"] if more > 0 else [])]
