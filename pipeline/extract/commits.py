"""Rows on their way to the disk, in order, while the model goes on."""

import queue
import threading
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from pipeline.extract.rows import KnownRow, ReadyRow, RepeatedRow
from pipeline.store import StoreBuild
from pipeline.store.schema import FEATURES

_WAITING = 1
"""Commits that may wait for the disk; the model waits when there are more, and a kill loses few."""

TOGETHER = 64
"""Known or repeated rows that are committed in one go: each commit waits for the disk."""


class Commits:
    """Commits on a thread of its own; what fails there is raised by the next call.

    Leaving the context waits for what was handed in, whatever else went wrong: it is computed.
    """

    def __init__(self, build: StoreBuild, done: Callable[[int], object]) -> None:
        """`done` is told how many rows each commit brought."""
        self.known = self.repeated = 0
        self._build = build
        self._done = done
        self._environment: Mapping[str, Any] = {}
        self._known: list[KnownRow] = []
        self._repeated: list[RepeatedRow] = []
        self._handed_in: set[int] = set()
        self._jobs: queue.Queue[Callable[[], int] | None] = queue.Queue(_WAITING)
        self._failed: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="commit", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            if error is None:
                self._flush()
        finally:
            self._jobs.put(None)
            self._thread.join()
        if error is None:
            self._check()

    def computed(
        self, rows: Sequence[ReadyRow], features: NDArray[Any], environment: Mapping[str, Any]
    ) -> None:
        """Commit a batch of the model's, which works in this environment throughout."""
        self._environment = environment
        keys = [one.key for one in rows]
        self._put(lambda: self._commit([one.row for one in rows], features, keys, environment))
        self._handed_in |= {one.row for one in rows}

    def model_rows(self, rows: Iterable[KnownRow | ReadyRow | RepeatedRow]) -> Iterator[ReadyRow]:
        """The rows that the model has to compute; the others are committed on the way."""
        for row in rows:
            self._check()
            if isinstance(row, ReadyRow):
                yield row
            elif isinstance(row, KnownRow):
                self._known.append(row)
                if len(self._known) == TOGETHER:
                    self._commit_known()
            else:
                self._repeated.append(row)
                if len(self._repeated) % TOGETHER == 0:
                    self._commit_repeated()

    def _flush(self) -> None:
        self._commit_known()
        self._commit_repeated()
        assert not self._repeated, "a repeated row whose first was never computed"

    def _commit_known(self) -> None:
        known, self._known = self._known, []
        self.known += len(known)
        if known:
            self._put(lambda: commit_known(self._build, known))

    def _commit_repeated(self) -> None:
        """Those whose first is on its way before them."""
        ready = [one for one in self._repeated if one.first in self._handed_in]
        self._repeated = [one for one in self._repeated if one.first not in self._handed_in]
        self.repeated += len(ready)
        environment = self._environment

        def copy() -> int:
            written = self._build.files(FEATURES)
            features = np.concatenate([written.read(one.first, 1) for one in ready])
            keys = [one.key for one in ready]
            return self._commit([one.row for one in ready], features, keys, environment)

        if ready:
            self._put(copy)

    def _commit(
        self,
        rows: Sequence[int],
        features: NDArray[Any],
        keys: Sequence[bytes],
        environment: Mapping[str, Any],
    ) -> int:
        self._build.commit(rows, features, keys, self._build.environment_index(environment))
        return len(rows)

    def _put(self, job: Callable[[], int]) -> None:
        self._check()
        self._jobs.put(job)

    def _check(self) -> None:
        if self._failed is not None:
            raise self._failed

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            if self._failed is not None:
                continue  # the reader must not wait for room
            try:
                self._done(job())
            except BaseException as error:
                self._failed = error


def commit_known(build: StoreBuild, known: Sequence[KnownRow]) -> int:
    """Commit rows that a donor has, with the environments that they were computed in."""
    by_environment: dict[int, list[KnownRow]] = defaultdict(list)
    for one in known:
        by_environment[build.environment_index(one.environment)].append(one)
    for number, rows in by_environment.items():
        features = np.stack([one.features for one in rows])
        build.commit([one.row for one in rows], features, [one.key for one in rows], number)
    return len(known)
