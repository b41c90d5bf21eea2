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
        free = max(0, len(self._buffer) - self.count)
        return np.roll(self._buffer, -self.count, axis=0)[free:]


class Timings(Ring):
    """Milliseconds of parts, a row a tick or an answer; NaN where a part did not happen."""

    def __init__(self, parts: Sequence[str], rows: int) -> None:
        self.parts = tuple(parts)
        super().__init__(rows, len(self.parts))

    def document(self) -> dict[str, dict[str, float]]:
        """By part, in ms, of the rows that are kept: how often it was, percentiles, the most."""
        found: dict[str, dict[str, float]] = {}
        for part, column in zip(self.parts, self.rows().T, strict=True):
            if len(values := column[~np.isnan(column)]):
                at = np.percentile(values, list(PERCENTILES.values())).tolist()
                named = dict(zip(PERCENTILES, at, strict=True))
                found[part] = {"count": len(values), **named, "max": float(values.max())}
        return found

    def table(self, caption: str = "") -> Table:
        """`document` as rows."""
        heads = ("part", "times", *(f"{name} [ms]" for name in (*PERCENTILES, "max")))
        rows: list[tuple[Any, ...]] = [(part, *d.values()) for part, d in self.document().items()]
        return Table(heads, rows, caption)
