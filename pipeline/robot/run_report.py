"""How a run on a robot went: timings, missed ticks, actions, and why it ended. Numpy only."""

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from pipeline.base.text import Table
from pipeline.robot.loop import StopKind

TickPart = Literal["late", "observe", "check", "plan", "frames", "ask", "act", "record"]
"""late: from the deadline to the beginning of the tick; the others are in the order of a tick."""
TICK_PARTS: tuple[TickPart, ...] = get_args(TickPart)
ANSWER_PARTS = ("answer", "infer_ms", "vlm_ms", "head_ms", "wait_ms")
"""answer: from the question to its answer; the others come from the answer's `server_timing`."""
KEPT = 65536
"""A report keeps the timings and actions of so many newest ticks."""
PERCENTILES = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9}


def allowed_ms(horizon: int, hz: float) -> float:
    """How long an answer may take: half of a chunk of `horizon` steps at `hz`."""
    return 500 * horizon / hz


class Timings:
    """Milliseconds of parts, a row for each tick or answer; NaN if a part did not happen.

    The newest `rows` rows stay, in a buffer that is never reallocated.
    """

    def __init__(self, parts: Sequence[str], rows: int) -> None:
        self.parts = tuple(parts)
        self._buffer = np.full((rows, len(self.parts)), np.nan)
        self.count = 0
        """The number of rows ever added."""

    def note(self, row: Sequence[float] | NDArray[np.float64]) -> None:
        """Add a row, in place of the oldest where the buffer is full."""
        self._buffer[self.count % len(self._buffer)] = row
        self.count += 1

    def rows(self) -> NDArray[np.float64]:
        """A copy of the kept rows, oldest first."""
        free = max(0, len(self._buffer) - self.count)
        return np.roll(self._buffer, -self.count, axis=0)[free:]

    def document(self) -> dict[str, dict[str, float]]:
        """For each part, over the kept rows: its count, and percentiles and maximum in ms."""
        parts: dict[str, dict[str, float]] = {}
        for part, column in zip(self.parts, self.rows().T, strict=True):
            if len(values := column[~np.isnan(column)]):
                at = np.percentile(values, list(PERCENTILES.values())).tolist()
                percentiles = dict(zip(PERCENTILES, at, strict=True))
                parts[part] = {"count": len(values), **percentiles, "max": float(values.max())}
        return parts

    def table(self, caption: str = "") -> Table:
        """The rows of `document`."""
        heads = ("part", "times", *(f"{name} [ms]" for name in (*PERCENTILES, "max")))
        rows: list[tuple[Any, ...]] = [(part, *d.values()) for part, d in self.document().items()]
        return Table(heads, rows, caption)


class TickTimer:
    """The seconds that each part of one tick takes."""

    def begin(self, deadline: float) -> None:
        """Begin a tick; the time since its deadline counts as late."""
        self.seconds: dict[TickPart, float] = {}
        self.part: TickPart = "late"
        self._since = deadline

    def mark(self, part: TickPart) -> None:
        """End the current part, and begin `part`."""
        now = time.monotonic()
        self.seconds[self.part] = self.seconds.get(self.part, 0.0) + now - self._since
        self.part, self._since = part, now

    def end(self) -> float:
        """End the tick; returns the time of its end in s."""
        self.mark("late")
        return self._since

    def row_ms(self) -> list[float]:
        """The ms of each of `TICK_PARTS`, NaN if it did not happen, and last those of the tick."""
        tick = sum(seconds for part, seconds in self.seconds.items() if part != "late")
        return [*(1000 * self.seconds.get(part, math.nan) for part in TICK_PARTS), 1000 * tick]


class RunReport:
    """How a run went and why it ended; timings are of the newest `KEPT` ticks."""

    def __init__(self) -> None:
        self.kind, self.reason = StopKind.LOOP, "the process ends"
        self.tick_timings = Timings((*TICK_PARTS, "tick"), KEPT)
        self.answer_timings = Timings(ANSWER_PARTS, KEPT)
        self.ticks = self.left_out = self.missed_ticks = 0
        """Ticks that were run, ticks skipped because one before took too long, and late ticks."""
        self.clipped = 0
        """Ticks in which limits clipped the action."""
        self.recording: Path | None = None
        self.traceback = ""
        """Tracebacks of all errors, also in stopping and in recording; empty if all went well."""

    @property
    def answers(self) -> int:
        """Answers of the policy."""
        return self.answer_timings.count
