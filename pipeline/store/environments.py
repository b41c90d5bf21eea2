"""With which software and hardware each feature row was computed.

Recorded, not part of a feature's identity. While a store is built, a number a row is kept in a
file of its own; sealing folds it into ranges of rows in the store's attributes.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.durable import sync


def environment_at(ranges: Sequence[Mapping[str, Any]], row: int) -> dict[str, Any]:
    """What a row was computed with, by the ranges of a store; empty where it is not noted."""
    noted = next((noted for noted in ranges if row in range(*noted["rows"])), {})
    return {name: value for name, value in noted.items() if name != "rows"}


def runs_of(rows: NDArray[np.int64]) -> list[range]:
    """Consecutive rows among these, which ascend."""
    runs = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1)
    return [range(int(run[0]), int(run[-1]) + 1) for run in runs if len(run)]


def environment_runs(
    ranges: Sequence[Mapping[str, Any]], rows: NDArray[np.int64]
) -> Iterator[tuple[dict[str, Any], range]]:
    """Consecutive rows among these, which ascend, that were computed in one environment."""
    edges = [edge for noted in ranges for edge in noted["rows"]]
    for part in np.split(rows, np.searchsorted(rows, np.unique(edges))):
        for run in runs_of(part):
            yield environment_at(ranges, run.start), run


class EnvironmentLog:
    """The environments of a build's rows, kept beside its arrays until it is sealed."""

    def __init__(self, part: Path) -> None:
        self._listed = part / ".environments.json"
        self._of_row = part / ".environment_of_row"
        self._temporary = part / ".environments.json.tmp"

    @property
    def noted(self) -> bool:
        """Whether there is anything to fold."""
        return self._listed.exists()

    def index(self, environment: Mapping[str, Any]) -> int:
        """The number of an environment, a new one if it is new."""
        known = self._known()
        if environment not in known:
            known.append(dict(environment))
            self._temporary.write_text(json.dumps(known))
            sync(self._temporary)
            self._temporary.replace(self._listed)
        return known.index(dict(environment))

    def note(self, start: int, count: int, number: int) -> None:
        """Say with which environment a run of rows was computed."""
        descriptor = os.open(self._of_row, os.O_WRONLY | os.O_CREAT, 0o644)
        try:
            os.pwrite(descriptor, np.full(count, number, "<u2").tobytes(), start * 2)
        finally:
            os.close(descriptor)

    def ranges(self) -> list[dict[str, Any]]:
        """`[{"rows": [start, stop], **environment}, ...]`, in order."""
        known, ranges, start = self._known(), [], 0
        numbers = np.fromfile(self._of_row, "<u2") if self._of_row.exists() else np.zeros(0, "<u2")
        for run in np.split(numbers, np.flatnonzero(np.diff(numbers)) + 1):
            if len(run):
                ranges.append({"rows": [start, start + len(run)], **known[run[0]]})
                start += len(run)
        return ranges

    def remove(self) -> None:
        """Forget it; a kill between the two leaves nothing that would be folded again."""
        for path in (self._listed, self._of_row, self._temporary):
            path.unlink(missing_ok=True)

    def _known(self) -> list[dict[str, Any]]:
        return json.loads(self._listed.read_text()) if self._listed.exists() else []
