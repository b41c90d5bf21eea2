"""What a run writes down while it goes: its curves, to every logger, and speed beside them."""

import csv
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Self

from pipeline.base.config import TrainHeadParams
from pipeline.base.durable import disk_full_named, fresh
from pipeline.base.ownership import OutputKind, begins_with, refuse_foreign
from pipeline.train.loggers import Logger, open_loggers
from pipeline.train.speed import Pace
from pipeline.train.world import World

_SPEED = ("step", "steps_per_s", "data_wait_share", "peak_memory_mib", "trained_s")

Row = tuple[int, Mapping[str, float]]
"""A step, counted from 1, and metrics by name."""


def speed_file(logs: Path) -> Path:
    """Where a training writes its speed: beside its logs, for DVC tracks all that is in them."""
    return logs.with_name(f"{logs.name}.speed.tsv")


class TrainingLog:
    """Hands the same rows to every logger, and keeps them.

    What came before a stop is given back as `earlier` and written again: DVC may have deleted the
    folder since, and a run that was killed has logged steps beyond its last checkpoint. Speed and
    memory since the last start go to `speed_file`, so that the folder, which DVC tracks, holds
    nothing of the clock. Raises `DiskFull`.
    """

    def __init__(
        self, folder: Path, loggers: Sequence[Logger], earlier: Iterable[Row] = ()
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._loggers = folder, loggers
        self.rows: list[Row] = []
        refuse_foreign(
            speed_file(folder), OutputKind("a run's speed", begins_with("\t".join(_SPEED)))
        )
        self._speed = fresh(speed_file(folder)).open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._speed, delimiter="\t")
        self._writer.writerow(_SPEED)
        for step, metrics in earlier:
            self.write(step, metrics)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Add a point to each of these curves, everywhere."""
        self.rows.append((step, dict(metrics)))
        with disk_full_named(self._folder):
            for logger in self._loggers:
                logger.write(step, metrics)

    def write_speed(self, step: int, pace: Pace) -> None:
        """Add a line to `speed_file`."""
        with disk_full_named(self._folder):
            self._writer.writerow(
                [
                    step,
                    f"{pace.steps_per_s:.3f}",
                    f"{pace.data_wait_share:.4f}",
                    f"{pace.peak_memory / 2**20:.0f}",
                    f"{pace.trained_s:.3f}",
                ]
            )
            self._speed.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *raised: object) -> None:
        with disk_full_named(self._folder), ExitStack() as closing:
            # Whatever one logger does, the others are closed too.
            for logger in reversed(self._loggers):
                closing.callback(logger.close, kind is None)
            closing.callback(self._speed.close)


@contextmanager
def open_log(
    params: TrainHeadParams, resumed: bool, earlier: Iterable[Row], world: World
) -> Generator[TrainingLog | None]:
    """Rank 0's log, to the loggers of `params`, which says where to look; None on the others.

    Where it cannot begin, no process waits for another. Raises `ConfigError` or `DiskFull`.
    """
    opened: list[TrainingLog] = []
    with ExitStack() as stack:

        def begin() -> None:
            with disk_full_named(params.logs):
                loggers = open_loggers(params, resumed)
            opened.append(stack.enter_context(TrainingLog(params.logs, loggers, earlier)))
            world.say(*(logger.note for logger in loggers if logger.note))

        world.shared(begin)
        yield opened[0] if opened else None
