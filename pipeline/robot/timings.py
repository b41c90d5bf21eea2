"""How long each part of a robot's loop took: the newest ticks, in buffers that stay. Numpy only."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.table import Table

PERCENTILES = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9}


class Ring:
    """The newest `rows` rows (row, column) of float64, in a buffer that stays."""

    def __init__(self, rows: int, columns: int) -> None:
        self._buffer = np.full((rows, columns), np.nan)
        self.count = 0
        """Rows that ever came."""

    def note(self, row: Iterable[float] | NDArray[np.float64]) -> None:
        """Take a row, in place of the oldest where there is no room."""
        self._buffer[self.count % len(self._buffer)] = row  # pyright: ignore[reportArgumentType]
        self.count += 1

    def rows(self) -> NDArray[np.float64]:
        """A copy of the rows that are kept, oldest first."""
        kept, at = len(self._buffer), self.count % len(self._buffer)
        if self.count <= kept:
            return self._buffer[: self.count].copy()
        return np.roll(self._buffer, -at, axis=0)


class Timings:
    """Milliseconds of parts, a row a tick or an answer; NaN where a part did not happen."""

    def __init__(self, parts: Sequence[str], rows: int) -> None:
        self.parts = tuple(parts)
        self.ring = Ring(rows, len(self.parts))
        self._most = np.full(len(self.parts), np.nan)

    def note(self, row: NDArray[np.float64]) -> None:
        """Take the milliseconds (part,) of one more."""
        self.ring.note(row)
        np.fmax(self._most, row, out=self._most)

    def document(self) -> dict[str, dict[str, float]]:
        """By part, in ms: how often it was, its percentiles, and the most ever, also where the
        buffer has gone round."""
        rows, found = self.ring.rows(), {}
        for column, part in enumerate(self.parts):
            values = rows[:, column]
            values = values[~np.isnan(values)]
            if len(values):
                at = np.percentile(values, list(PERCENTILES.values()))
                named = zip(PERCENTILES, map(float, at), strict=True)
                found[part] = {
                    "count": len(values),
                    **dict(named),
                    "max": float(self._most[column]),
                }
        return found

    def table(self, caption: str = "") -> Table:
        """`document` as rows."""
        heads = ("part", "times", *(f"{name} [ms]" for name in (*PERCENTILES, "max")))
        rows: list[tuple[Any, ...]] = [(part, *d.values()) for part, d in self.document().items()]
        return Table(heads, rows, caption)
