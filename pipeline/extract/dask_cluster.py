"""The executor on dask workers: they write ranges of rows, this process marks what was written.

Dask repeats tasks that failed or whose worker died. The tasks that dask gives up run again at the
end, one episode at a time, so that no recording is blamed for another. Each worker process holds
one model, and its threads take turns with it: while one thread encodes, the others prepare.
"""

import math
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Generator, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import closing, contextmanager
from functools import partial
from itertools import islice
from multiprocessing import active_children, resource_tracker
from pathlib import Path
from typing import Any

import dask
import numpy as np
import torch
from distributed import (
    Client,
    Future,
    KilledWorker,
    LocalCluster,
    Worker,
    WorkerPlugin,
    as_completed,
    get_worker,
)
from distributed.scheduler import NoWorkerError
from numpy.typing import NDArray

from pipeline.base.config import ExtractParams
from pipeline.base.differences import describe, differences
from pipeline.base.digests import file_digest
from pipeline.base.errors import (
    ConfigError,
    NumericsError,
    PipelineError,
    RecordingError,
    StoreIncomplete,
)
from pipeline.base.scheduler import client_of, private_cluster, quiet
from pipeline.data.episode import RowFrames, by_episode
from pipeline.extract.build_state import row_sources
from pipeline.extract.engine import RowEngine, Speed
from pipeline.extract.rows import FeatureBlock, Row, RowMarks, WrittenRows, row_frames
from pipeline.extract.survey import Survey
from pipeline.store import FEATURES, RowSource, StoreBuild, part_path, read_plan
from pipeline.store.schema import read_specs
from pipeline.vlm.feature_spec import feature_spec

PAGE_BYTES = 4096

# Rows per task when each worker finds its own batch size.
_AUTO_RANGE_ROWS = 32

# Most tasks in the scheduler at a time: enough for hundreds of workers, never millions.
_TASKS_AHEAD = 1000

# If this many workers die before any row is written, no recording is to blame.
_HOPELESS_DEATHS = 4

# Time for local processes to come back after a death, however long their imports take.
_LOCAL_PATIENCE = {
    "distributed.deploy.lost-worker-timeout": "1h",
    "distributed.scheduler.no-workers-timeout": "120s",
}

_SETTING = "extract.workers"
_LOOK_EVERY_S = 0.05

# Rows that one task computes, ascending.
Range = NDArray[np.int64]
# What a task returned, or the exception that it raised.
Result = Any


def compute_rows(plugin: str, rows: Range) -> list[WrittenRows] | Exception:
    """The task: write the features of these rows.

    Raises `RecordingError` or `NumericsError` where a recording cannot be computed; dask then tries
    again. Returns an error that would stop every other row as well (no model, a full disk).
    """
    extraction: ExtractionPlugin = get_worker().plugins[plugin]  # pyright: ignore[reportAssignmentType]
    try:
        return extraction.compute(rows)
    except (RecordingError, NumericsError):
        raise
    except Exception as error:
        return error


class ExtractionPlugin(WorkerPlugin):
    """A worker's part of an extraction.

    The coordinator makes it, and dask sends it to every worker, also to workers that join later.
    """

    def __init__(self, surveyed: Survey, known: Sequence[Path]) -> None:
        """`known` are stores and builds of the same feature spec."""
        self.surveyed = surveyed
        self.known = [path.absolute() for path in known]
        # The next extraction of a store replaces the plugin of one that was killed.
        self.name = f"extraction of {surveyed.target.absolute()}"

    @property
    def local(self) -> bool:
        """Whether all workers are on the coordinator's host."""
        return isinstance(self.surveyed.extract.workers, int)

    def setup(self, worker: Worker) -> None:
        """Open nothing yet: the first task does, so that a failure there is that task's error."""
        self._number = worker.name
        self._engine: RowEngine | None = None
        self._closed = False
        self._opening, self._model_turn, self._disk_turn = (threading.Lock() for _ in range(3))

    def teardown(self, worker: Worker) -> None:
        """Close the files between two writes; a range that is still computed is not written."""
        with self._opening, self._disk_turn:
            self._closed = True
            if self._engine is not None:
                self._engine = None
                self._build.close()

    def compute(self, rows: Range) -> list[WrittenRows]:
        """Write the features of these rows; rows of equal key are computed once."""
        engine = self._opened()
        prepared = _prepared(engine, rows)
        blocks: list[FeatureBlock] = []
        with self._model_turn:
            engine.encode(iter([prepared]), blocks.append)
        with self._disk_turn:
            if self._closed:
                raise StoreIncomplete(f"{self.name} has ended; its rows are nobody's")
            return [block.write(self._build) for block in blocks]

    def check_place(self) -> None:
        """Raise `ConfigError` where this worker does not see the build or has another model."""
        host, surveyed = socket.gethostname(), self.surveyed
        if read_plan(part := part_path(surveyed.target)) != surveyed.plan:
            raise ConfigError(
                f"the worker on {host} finds no build {part} from its folder {Path.cwd()}. Start "
                "every worker in the coordinator's folder, and set extract.store to a folder of a "
                "file system that all hosts share."
            )
        if not self.local:
            vlm, dtype, spec = surveyed.vlm, surveyed.extract.dtype, surveyed.spec
            ours = feature_spec(vlm, dtype, spec.views, file_digest)
            if ours.digest != spec.digest:
                lines = "; ".join(describe(differences(ours.attrs(), spec.attrs())))
                raise ConfigError(
                    f"the worker on {host} would compute other features than the coordinator asks "
                    f"for: {lines}. Give it the same checkpoint and the same version of this "
                    "package."
                )

    def device_of(self, worker_name: object) -> str:
        """The device of a worker: local ones take turns over the GPUs, others use their first.

        dask-cuda and CUDA_VISIBLE_DEVICES show each of those workers its own GPU first.
        """
        wanted, devices = self.surveyed.extract.device, torch.cuda.device_count()
        turns = wanted in ("auto", "cuda") and devices > 1
        if self.local and isinstance(worker_name, int) and turns:
            return f"cuda:{worker_name % devices}"
        return wanted

    def _opened(self) -> RowEngine:
        """The worker's engine; its files are opened on the first call."""
        with self._opening:
            if self._engine is None:
                self.check_place()
                surveyed, known = self.surveyed, row_sources(self.known, self.surveyed)
                specs = read_specs(part_path(surveyed.target))
                self._build = StoreBuild(surveyed.target, specs, surveyed.plan)
                frames = row_frames(self._build, surveyed)
                self._engine = RowEngine(surveyed, frames, known, self.device_of(self._number))
            return self._engine


def _prepared(engine: RowEngine, rows: Range) -> list[Row]:
    firsts: dict[bytes, int] = {}
    try:
        parts = engine.frames.ranges(rows)
        return [row for part in parts for row in engine.preparation.prepare(part, firsts)]
    except RecordingError:
        raise
    except Exception as error:  # a damaged recording may raise anything in its decoder
        raise RecordingError(f"{type(error).__name__}: {error}") from None


def compute_on_cluster(
    surveyed: Survey,
    known: Sequence[RowSource],
    frames: RowFrames,
    missing: Range,
    marks: RowMarks,
) -> Speed:
    """The executor of `extract.workers`; the speed counts the rows after the first result.

    An error that stops every row is raised at once: `ConfigError` for a wrong address or a worker
    that does not see the same files, `VLMError`, `DiskFull`, `PipelineError` where the scheduler or
    all workers are lost. Raises `RecordingError` after all other rows where some could not be
    computed.
    """
    extract, array = surveyed.extract, marks.build.specs[FEATURES]
    plugin = ExtractionPlugin(surveyed, [source.path for source in known])
    rows = _AUTO_RANGE_ROWS if extract.batch_size == "auto" else extract.batch_size
    most = max(1, rows // surveyed.spec.variants)
    # On several hosts, no two ranges may share a page of the file.
    page_rows = PAGE_BYTES // math.gcd(array.row_bytes, PAGE_BYTES)
    together = 1 if plugin.local else page_rows  # it divides every chunk
    ranges = ranges_of(missing, most, array.chunk_rows, together)
    begun, before = 0.0, 0
    with connected(extract) as client, _plugged(client, plugin):
        tasks = ClusterTasks(client, plugin, frames.vl_start)
        with closing(tasks.results(ranges)) as results:
            for written in results:
                marks.mark(written)
                if not before:  # until then workers start and load the model
                    begun, before = time.monotonic(), marks.counts["computed"]
    later = marks.counts["computed"] - before
    return Speed(later / (time.monotonic() - begun) if later else None)


class ClusterTasks:
    """Sends ranges to the workers and collects their results."""

    def __init__(
        self, client: Client, plugin: ExtractionPlugin, vl_start: NDArray[np.int64]
    ) -> None:
        self._client = client
        self._plugin = plugin
        self._vl_start = vl_start
        self._dead: set[str] = set()
        self._any_written = False

    def results(self, ranges: Iterable[Range]) -> Generator[list[WrittenRows]]:
        """The rows that workers wrote; raises one error at the end for those that failed."""
        given_up: list[Range] = []
        for done in self._completed(ranges, self._plugin.surveyed.extract.retries):
            written = [block for _, result in done if isinstance(result, list) for block in result]
            self._any_written |= bool(written)
            yield written
            for rows, result in done:
                if not isinstance(result, list):
                    self._raise_unless_recording(result)
                    given_up.append(rows)
        failed: dict[int, str] = {}
        for rows in given_up:
            for episode, inside in by_episode(rows, self._vl_start):
                if episode not in failed:
                    (((_, result),),) = self._completed([inside], retries=0)
                    if isinstance(result, list):
                        yield result
                    else:
                        failed[episode] = self._reason(episode, inside, result)
        if failed:
            reasons = "\n".join(f"  {failed[episode]}" for episode in sorted(failed))
            raise RecordingError(
                f"{len(failed)} episodes could not be computed:\n{reasons}\nAll others are kept. "
                "Mend or remove these recordings and run the same command again."
            )

    def _completed(
        self, ranges: Iterable[Range], retries: int
    ) -> Iterator[list[tuple[Range, Result]]]:
        """Ranges with their results, in the order in which they finish."""
        left, under_way = iter(ranges), dict[Future[Any], Range]()
        submit = partial(self._client.submit, compute_rows, self._plugin.name, pure=False)

        def submitted(count: int) -> Iterable[Future[Any]]:
            futures = {submit(rows, retries=retries): rows for rows in islice(left, count)}
            under_way.update(futures)
            return futures

        completed = as_completed(
            submitted(_TASKS_AHEAD), loop=self._client.loop, with_results=True, raise_errors=False
        )
        for batch in completed.batches():
            done: list[tuple[Range, Result]] = []
            for future, result in batch:
                error = result[1] if isinstance(result, tuple) else result
                done.append((under_way.pop(future), error))
                future.release()  # otherwise dask computes it again if its worker dies
            completed.update(submitted(len(batch)))
            yield done

    def _raise_unless_recording(self, error: Exception) -> None:
        """Raise the error unless a recording may have caused it."""
        if isinstance(error, KilledWorker):
            self._dead.add(error.last_worker.address)
        hopeless = len(self._dead) >= _HOPELESS_DEATHS and not self._any_written
        if hopeless or isinstance(error, CancelledError | NoWorkerError):
            raise PipelineError(
                f"the dask workers or their scheduler were lost ({error}): killed, out of memory, "
                "or not reached. What was written is kept: look at their logs, give them more "
                "memory or take fewer extract.workers, and run the same command again."
            )
        if not isinstance(error, KilledWorker | RecordingError | NumericsError):
            raise error

    def _reason(self, episode: int, rows: Range, error: Exception) -> str:
        """Why the rows of an episode could not be computed, even without other rows."""
        self._raise_unless_recording(error)
        if isinstance(error, KilledWorker):
            deaths = 1 + error.allowed_failures
            error = RecordingError(f"every worker died that computed them alone ({deaths} deaths)")
        path = str(self._plugin.surveyed.recordings[episode].path)
        where = "" if path in str(error) else f"{path}, VL rows {rows[0]} to {rows[-1]}: "
        return f"{where}{error}"


def ranges_of(missing: Range, most: int, chunk_rows: int, together: int = 1) -> list[Range]:
    """The ranges of `missing` (ascending) that tasks compute: `most` rows each, or a few more.

    A range lies within one chunk. Blocks of `together` rows, which divide a chunk, are never cut:
    hosts must not share a page.
    """
    chunk, block = missing // chunk_rows, missing // together
    begin = np.searchsorted(block, block) - np.searchsorted(chunk, chunk)
    cuts = (np.diff(begin // most) != 0) | (np.diff(chunk) != 0)
    return np.split(missing, np.flatnonzero(cuts) + 1)


@contextmanager
def _plugged(client: Client, plugin: ExtractionPlugin) -> Generator[None]:
    """Give the plugin to every worker, now and later; take it back at the end."""
    try:
        client.register_plugin(plugin)
    except (ImportError, OSError) as error:
        raise ConfigError(
            f"extract.workers: a worker cannot begin ({error}). Install the same version of this "
            f"package there as on {socket.gethostname()}, or give it more memory."
        ) from None
    try:
        yield
    finally:
        if client.status == "running":
            client.unregister_worker_plugin(plugin.name)


@contextmanager
def connected(extract: ExtractParams) -> Generator[Client]:
    """A client of `extract.workers`; local processes end with it.

    Raises `ConfigError` where no scheduler answers at the address, `PipelineError` where local
    processes cannot be started.
    """
    with quiet():
        if isinstance(extract.workers, int):
            with (
                dask.config.set(_LOCAL_PATIENCE),
                _local_cluster(extract.workers, extract) as cluster,
                Client(cluster, set_as_default=False) as client,
            ):
                yield client
        else:
            with client_of(extract.workers, _SETTING) as client:
                if not client.nthreads():
                    print(f"{extract.workers}: waiting for a first worker", file=sys.stderr)
                yield client


@contextmanager
def _local_cluster(workers: int, extract: ExtractParams) -> Generator[LocalCluster]:
    """Worker processes of this host; raises `PipelineError` where they cannot be started.

    To interrupt dask while they start leaves error output and orphan processes. So a thread starts
    them, and an interrupted coordinator kills the processes; that thread then ends by itself.
    """
    cores = len(os.sched_getaffinity(0))
    threads = os.environ.get("OMP_NUM_THREADS") or str(max(1, cores // workers))
    env: dict[str, str] = dict.fromkeys(
        ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), threads
    )
    start = partial(private_cluster, workers, 1 + extract.decode_threads, extract.retries, env)
    others = set(active_children())
    with ThreadPoolExecutor(1) as pool:
        # Ctrl-C reaches the whole process group, but only the coordinator may act on it: threads
        # and processes, also workers that restart later, inherit the signal mask of their parent.
        resource_tracker.ensure_running()  # now: it unblocks SIGINT in the calling thread
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        starting = pool.submit(start)
        try:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            try:
                cluster = starting.result()
            except (RuntimeError, OSError) as error:
                raise PipelineError(
                    f"extract.workers: {workers} worker processes could not be started "
                    f"({error.__cause__ or error}): one was killed, or ran out of memory. Run the "
                    "same command again, with fewer extract.workers, or with extract.workers=0."
                ) from None
            yield cluster
        finally:
            while not starting.done():
                for child in set(active_children()) - others:
                    child.kill()
                time.sleep(_LOOK_EVERY_S)
            if starting.exception() is None:
                starting.result().close()
