"""Hand tasks out to dask workers, a few ahead, and judge what comes back.

What a worker had when it died is tried again; a recording that no worker can compute is given up
and reported at the end, when all other rows are done.
"""

import math
import sys
import time
import uuid
from collections import deque
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from distributed import Client, Future, KilledWorker, as_completed
from tqdm import tqdm

from pipeline.base.errors import PipelineError, RecordingError
from pipeline.extract.job import Outcome, Piece, WrittenRows
from pipeline.extract.worker import compute_pieces

_TASKS_A_THREAD = 2
"""Handed out ahead, so that no worker waits and a scheduler never holds millions."""

_COUNT_THREADS_EVERY_S = 2.0

_LOOK_EVERY_S = 0.01

_LOST = (
    "the connection to the dask scheduler was lost ({}). The rows that were written are kept: "
    "start the scheduler and its workers again, and run the same command; it computes what is "
    "missing."
)

_HOPELESS_DEATHS = 8
"""So many workers dead before a single row is written are no recording's fault."""


@dataclass
class Task:
    """A range that is handed out, and how often it has failed."""

    pieces: list[Piece]
    failures: int = 0
    alone: bool = False
    """Computed while nothing else is, so that a death is surely its own."""


class TaskScheduler:
    """Tasks on their way to workers and back."""

    def __init__(
        self,
        client: Client,
        plugin: str,
        fresh: Iterator[Task],
        retries: int,
        patience_s: float = math.inf,
    ) -> None:
        """Without a worker for `patience_s` it gives up; a cluster's queue may take its time."""
        self._client = client
        self._plugin = plugin
        self._fresh = fresh
        self._retries = retries
        self._again: deque[Task] = deque()
        self._suspects: deque[Task] = deque()
        self._suspected: set[int] = set()
        self._given_up: dict[int, str] = {}
        self._under_way: dict[Future[Any], Task] = {}
        self._completed: Any = as_completed(
            [], loop=client.loop, with_results=True, raise_errors=False
        )
        self._session = uuid.uuid4().hex
        self._handed_out = 0
        self._room, self._counted = 1, -math.inf
        self._patience_s, self._last_worker = patience_s, time.monotonic()
        self._dead: set[str] = set()
        self._any_written = False

    def results(self) -> Generator[WrittenRows]:
        """What workers wrote; raises at the end what could not be computed."""
        self._hand_out()
        while self._under_way:
            written: list[WrittenRows] = []
            try:
                for future, result in self._finished():
                    written += self._judged(self._under_way.pop(future), result)
            except Exception:  # stops the run; what others wrote is kept
                yield from together(written)
                raise
            self._any_written |= bool(written)
            self._hand_out()
            yield from together(written)
        if self._given_up:
            raise RecordingError(self._report())

    def _finished(self) -> list[tuple[Future[Any], Any]]:
        """What came back; nothing where it is time to look for workers that joined or left."""
        while not self._completed.has_ready():
            if time.monotonic() - self._counted > _COUNT_THREADS_EVERY_S:
                return []
            time.sleep(_LOOK_EVERY_S)
        return self._completed.next_batch(block=False)

    def _count_threads(self) -> None:
        try:
            threads: Mapping[str, int] = self._client.nthreads()  # pyright: ignore
        except OSError as error:
            raise PipelineError(_LOST.format(error)) from None
        self._counted = time.monotonic()
        self._room = _TASKS_A_THREAD * max(1, sum(threads.values()))
        if threads:
            self._last_worker = self._counted
        elif self._counted - self._last_worker > self._patience_s:
            raise PipelineError(
                f"no worker has been there for {self._patience_s:.0f} s: they were killed, or ran "
                "out of memory as they began. The rows that were written are kept. Run the same "
                "command again, with fewer extract.workers where memory is short."
            )

    def _hand_out(self) -> None:
        if time.monotonic() - self._counted > _COUNT_THREADS_EVERY_S:
            self._count_threads()
        while len(self._under_way) < self._room and (task := self._next()) is not None:
            self._submit(task)
        while not self._under_way and self._suspects:
            task = self._without_given_up(self._suspects.popleft())
            if task.pieces:
                task.alone = True
                self._submit(task)

    def _next(self) -> Task | None:
        """The next task that may be computed beside others."""
        while (task := self._again_or_fresh()) is not None:
            if not self._without_given_up(task).pieces:
                continue
            if self._suspected.isdisjoint(piece.episode for piece in task.pieces):
                return task
            self._suspects.append(task)
        return None

    def _again_or_fresh(self) -> Task | None:
        return self._again.popleft() if self._again else next(self._fresh, None)

    def _without_given_up(self, task: Task) -> Task:
        task.pieces = [piece for piece in task.pieces if piece.episode not in self._given_up]
        return task

    def _submit(self, task: Task) -> None:
        self._handed_out += 1
        future = self._client.submit(
            compute_pieces,
            self._plugin,
            task.pieces,
            key=f"rows-{self._session}-{self._handed_out}",
            pure=False,
        )
        self._under_way[future] = task
        self._completed.add(future)

    def _judged(self, task: Task, result: Any) -> Sequence[WrittenRows]:
        if isinstance(result, Outcome):
            failed = [(task.pieces[place], reason) for place, reason in result.failed.items()]
            if task.alone:
                self._survived(task)
            if failed:
                again = Task([piece for piece, _ in failed], task.failures + 1)
                self._failed(again, {piece.episode: reason for piece, reason in failed})
            return result.written
        error = result[1] if isinstance(result, tuple) else result
        if isinstance(error, KilledWorker):
            self._died(task, error)
            return ()
        if isinstance(error, CancelledError):
            raise PipelineError(_LOST.format(error))
        raise error

    def _failed(self, task: Task, reasons: dict[int, str]) -> None:
        if task.failures > self._retries:
            self._given_up |= reasons
            return
        for reason in reasons.values():
            tqdm.write(f"tried again: {reason}", file=sys.stderr)
        self._again.append(task)

    def _died(self, task: Task, error: KilledWorker) -> None:
        """A worker died with the task; whose fault it was shows when it is computed alone."""
        address = str(error.last_worker.address)
        if address not in self._dead:
            self._dead.add(address)
            said = f"the worker {address} died; what it had is computed again at the end"
            tqdm.write(said, file=sys.stderr)
        if not self._any_written and len(self._dead) >= _HOPELESS_DEATHS:
            raise PipelineError(
                f"{len(self._dead)} workers died before a single row was written; "
                f"last {address}. Do the workers have enough memory for the model? Look "
                "at their logs, or run with extract.workers=0."
            )
        task.failures += 1 + error.allowed_failures
        if task.alone and len(task.pieces) == 1 and task.failures > self._retries:
            piece = task.pieces[0]
            self._given_up[piece.episode] = (
                f"{piece.recording.path}, VL rows {piece.rows[0]} to {piece.rows[-1]}: every "
                f"worker died that computed them alone ({task.failures} deaths)"
            )
            return
        # Piece by piece: a recording that shares a page with a poisoned one is not at fault.
        self._suspected |= {piece.episode for piece in task.pieces}
        self._suspects.extend(Task([piece], task.failures) for piece in task.pieces)

    def _survived(self, task: Task) -> None:
        """The other ranges of its episodes, which were only set aside, need not wait any more."""
        self._suspected -= {piece.episode for piece in task.pieces}
        self._again.extend(one for one in self._suspects if not one.failures)
        self._suspects = deque(one for one in self._suspects if one.failures)

    def _report(self) -> str:
        lines = [f"{len(self._given_up)} episodes could not be computed:"]
        lines += [f"  {reason}" for _, reason in sorted(self._given_up.items())]
        lines.append(
            "All other rows are kept. Mend or remove these recordings and run the same command "
            "again; it computes what is missing."
        )
        return "\n".join(lines)


def together(written: Sequence[WrittenRows]) -> Iterator[WrittenRows]:
    """The same rows in as few blocks as there are kinds: marking waits for the disk each time."""

    def kind(one: WrittenRows) -> tuple[str, str]:
        return one.came, repr(sorted(one.environment.items()))

    for _, alike in groupby(sorted(written, key=kind), kind):
        blocks = list(alike)
        yield WrittenRows(
            np.concatenate([block.rows for block in blocks]),
            [key for block in blocks for key in block.keys],
            np.concatenate([block.checksums for block in blocks]),
            blocks[0].environment,
            blocks[0].came,
        )
