"""Hand the missing rows out to dask workers and mark what they wrote.

The client is the coordinator: workers write feature rows, it alone marks them.
"""

import math
import socket
import time
from collections import Counter
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from distributed import Client

from pipeline.base.errors import ConfigError, PipelineError
from pipeline.extract.connection import connected
from pipeline.extract.handout import Task, TaskScheduler
from pipeline.extract.job import Job, Piece, WrittenRows
from pipeline.extract.ranges import by_episode, ranges_of, rows_between_pages
from pipeline.extract.work import Computed, Work
from pipeline.extract.worker import ExtractionPlugin
from pipeline.store import FEATURES

_AUTO_RANGE_ROWS = 32
"""Rows a task where each worker finds its own batch size."""

_LOCAL_PATIENCE_S = 120.0
"""For processes of this machine to come back after a death."""


def compute_on_cluster(work: Work) -> Computed:
    """Have `extract.workers` compute every missing row, and mark each as it is written.

    Raises at once what stops every row: `ConfigError` for a wrong address or a worker elsewhere,
    `VLMError`, `DiskFull`, `PipelineError` where the scheduler is lost. Raises `RecordingError`
    after all other rows where some failed more often than `extract.retries`.
    """
    extract = work.params.extract
    job = _job(work)
    patience_s = _LOCAL_PATIENCE_S if job.local else math.inf
    with connected(extract) as client, _plugged(client, job):
        handout = TaskScheduler(
            client, job.name, _tasks(work, job.local), extract.retries, patience_s
        )
        with closing(handout.results()) as written:
            return _marked(work, written)


def _job(work: Work) -> Job:
    """With every path that the coordinator may have given relative to its own folder."""
    extract = work.params.extract
    target = work.build.target.absolute()
    return Job(
        target,
        work.build.plan,
        work.spec,
        work.params.model_copy(update={"extract": extract.model_copy(update={"store": target})}),
        tuple(donor.path.absolute() for donor in work.donors),
        Path.cwd(),
        isinstance(extract.workers, int),
    )


def _tasks(work: Work, local: bool) -> Iterator[Task]:
    """A range of about one batch each; where hosts may differ, none shares a page with another."""
    array, size = work.build.specs[FEATURES], work.params.extract.batch_size
    batch = _AUTO_RANGE_ROWS if size == "auto" else size
    ranges = ranges_of(
        work.missing,
        work.vl_start,
        array.chunk_rows,
        max(1, batch // work.spec.variants),
        1 if local else rows_between_pages(array.row_bytes),
    )
    for one in ranges:
        pieces = by_episode(one, work.vl_start)
        yield Task(
            [
                Piece(episode, work.recordings[episode], rows, work.frame_time[rows])
                for episode, rows in pieces
            ]
        )


def _marked(work: Work, written: Iterable[WrittenRows]) -> Computed:
    """The rate is that after the first block: until then workers start and load the model."""
    rows: Counter[str] = Counter()
    begun, before = 0.0, 0
    for block in written:
        number = work.build.environment_index(block.environment)
        work.build.mark(block.rows, block.keys, block.checksums, number)
        work.done(len(block.rows))
        rows[block.came] += len(block.rows)
        if not before:
            begun, before = time.monotonic(), rows["computed"]
    later = rows["computed"] - before
    rate = later / (time.monotonic() - begun) if later else None
    return Computed(rows["computed"], rows["known"], rows["repeated"], rate)


@contextmanager
def _plugged(client: Client, job: Job) -> Generator[None]:
    """Give every worker, now and later, what it needs; take it back at the end."""
    try:
        client.register_plugin(ExtractionPlugin(job))
    except ImportError as error:
        raise ConfigError(
            f"extract.workers: a worker cannot import what it should run ({error}). Install the "
            f"same version of this package there as on {socket.gethostname()}."
        ) from None
    except OSError as error:
        raise PipelineError(
            f"extract.workers: a worker died as it began, or the scheduler with it ({error}). Run "
            "the same command again, with fewer extract.workers where memory is short."
        ) from None
    try:
        yield
    finally:
        if client.status == "running":
            client.unregister_worker_plugin(job.name)
