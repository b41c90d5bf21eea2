"""Hand the missing rows out to dask workers and gather what they wrote.

The client is the coordinator: workers write feature rows, it alone marks them.
"""

import math
import socket
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from distributed import Client
from numpy.typing import NDArray

from pipeline.config import Params
from pipeline.errors import ConfigError
from pipeline.extraction.connection import connected
from pipeline.extraction.handout import Handout, Task
from pipeline.extraction.ranges import by_episode, ranges_of, rows_between_pages
from pipeline.extraction.worker import ExtractionPlugin, Job, Piece, WrittenRows
from pipeline.recordings import Recording
from pipeline.store import FEATURES, StoreBuild
from pipeline.vlm.feature_spec import FeatureSpec

__all__ = ["WrittenRows", "compute_on_cluster"]

_AUTO_RANGE_ROWS = 32
"""Rows a task where each worker finds its own batch size."""

_LOCAL_PATIENCE_S = 120.0
"""For processes of this machine to come back after a death."""


def compute_on_cluster(
    build: StoreBuild,
    spec: FeatureSpec,
    recordings: Sequence[Recording],
    vl_start: NDArray[np.int64],
    frame_time: NDArray[np.float64],
    missing: NDArray[np.int64],
    donors: Sequence[Path],
    params: Params,
) -> Generator[WrittenRows]:
    """Compute missing rows on `extract.workers`; yields what is to be marked, as it is written.

    Raises at once what stops every row: `ConfigError` for a wrong address or a worker elsewhere,
    `VLMError`, `DiskFull`, `PipelineError` where the scheduler is lost. Raises `RecordingError`
    after all other rows where some failed more often than `extract.retries`. Close it when it is
    not read to its end: that stops the workers.
    """
    extract = params.extract
    local = isinstance(extract.workers, int)
    target = build.target.absolute()
    job = Job(
        target,
        build.plan,
        spec,
        params.model_copy(update={"extract": extract.model_copy(update={"store": target})}),
        tuple(path.absolute() for path in donors),
        Path.cwd(),
        local,
    )
    array = build.specs[FEATURES]
    batch = _AUTO_RANGE_ROWS if extract.batch_size == "auto" else extract.batch_size
    ranges = ranges_of(
        missing,
        vl_start,
        array.chunk_rows,
        max(1, batch // spec.variants),
        1 if local else rows_between_pages(array.row_bytes),
    )
    tasks = (
        Task(
            [
                Piece(episode, recordings[episode], rows, frame_time[rows])
                for episode, rows in by_episode(one, vl_start)
            ]
        )
        for one in ranges
    )
    with connected(extract) as client, _plugged(client, job):
        patience_s = _LOCAL_PATIENCE_S if local else math.inf
        yield from Handout(client, job.name, tasks, extract.retries, patience_s).results()


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
    try:
        yield
    finally:
        if client.status == "running":
            client.unregister_worker_plugin(job.name)
