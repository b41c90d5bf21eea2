"""What a check of a store found, for programs and for people."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.base.format import size
from pipeline.store.repair_hints import mend, start_over
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

    def span(self, kind: str, first: int, last: int) -> str:
        """`3 (episode 'x', tick 12) to 9 (episode 'y', tick 36)`; of one row, that row."""
        begin = f"{first}{self.of(kind, first)}"
        return begin if first == last else f"{begin} to {last}{self.of(kind, last)}"


@dataclass(frozen=True)
class Findings:
    """What was checked of a store and everything that is wrong with it."""

    store: Path
    rows: int
    """Feature rows that could be read and were checked."""
    bytes: int
    """Of the chunk files that were read, with the padding behind the last rows."""
    seconds: float
    row_bytes: int = 0
    """Of the rows of all arrays in these files."""
    inode: Inode | None = None
    """Of the store that was checked: another may have taken its place since."""
    damaged: tuple[Damage, ...] = ()
    """Arrays and chunk files."""
    problems: tuple[str, ...] = ()
    """What belongs to no array, such as files that have no place in a store."""
    faults: Mapping[str, NDArray[np.int64]] = field(default_factory=dict[str, NDArray[np.int64]])
    """The feature rows that cannot be used, ascending, by what is wrong with them."""
    places: Places = field(default_factory=lambda: Places({}, (), 1))
    notes: tuple[str, ...] = ()
    """What could not be checked."""
    plan: bool = True
    """Whether the metadata still say what the store was made of."""

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
        runs = runs_of(rows)
        lines = [
            f"VL row{'s' if last > first else ''} {self.places.span('vl', first, last)}: {what}"
            for first, last in runs[:MOST_LINES]
        ]
        more = sum(last - first + 1 for first, last in runs[MOST_LINES:])
        return [*lines, *([f"and {more} more VL rows: {what}"] if more else [])]

    def advice(self) -> str:
        """For people: what to run next."""
        if self.problems and not (self.damaged or self.faults):
            return "All that was stored is sound: look at these files and remove them."
        return mend(self.store) if self.plan else start_over(self.store)

    def summary(self) -> str:
        """For people: how much was checked, how fast."""
        rate = self.bytes / 1e9 / self.seconds if self.seconds else 0.0
        return (
            f"{self.store}: checked {self.rows} feature rows, {size(self.row_bytes)} of "
            f"rows in {size(self.bytes)} of files, in {self.seconds:.1f} s "
            f"({rate:.2f} GB/s)"
        )


def runs_of(rows: NDArray[np.int64]) -> list[tuple[int, int]]:
    """(first, last) of each run of consecutive rows, ascending."""
    runs = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1)
    return [(int(run[0]), int(run[-1])) for run in runs if len(run)]


def capped(lines: Sequence[str], kind: str) -> list[str]:
    """The first lines, and how many more there are."""
    more = len(lines) - MOST_LINES
    return [*lines[:MOST_LINES], *([f"and {more} more {kind}"] if more > 0 else [])]
