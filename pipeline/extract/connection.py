"""Reach the dask workers that compute rows: processes of this host, or those of a scheduler."""

import os
import signal
import sys
import time
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, resource_tracker

import dask
from distributed import Client, LocalCluster

from pipeline.base.config import ExtractParams
from pipeline.base.errors import PipelineError
from pipeline.base.scheduler import client_of, private_cluster, quiet

_SETTING = "extract.workers"
_LOOK_EVERY_S = 0.05


def check_scheduler(extract: ExtractParams) -> None:
    """Raise `ConfigError` where `extract.workers` is an address at which no scheduler answers."""
    if isinstance(extract.workers, str):
        with quiet(), client_of(extract.workers, _SETTING):
            pass


@contextmanager
def connected(extract: ExtractParams) -> Generator[Client]:
    """A client of `extract.workers`; local processes end with it.

    Raises `ConfigError` where no scheduler answers at the address, `PipelineError` where local
    processes cannot be started.
    """
    with quiet():
        if isinstance(extract.workers, int):
            with (
                dask.config.set({"distributed.deploy.lost-worker-timeout": "1h"}),
                _local_cluster(extract.workers, extract.decode_threads) as cluster,
                Client(cluster, set_as_default=False) as client,
            ):
                yield client
        else:
            with client_of(extract.workers, _SETTING) as client:
                if not client.nthreads():
                    said = "the scheduler has no worker yet; waiting for one"
                    print(f"{extract.workers}: {said}", file=sys.stderr)
                yield client


@contextmanager
def _local_cluster(workers: int, decode_threads: int) -> Generator[LocalCluster]:
    """Worker processes of this host, all of them up; raises `PipelineError` where they cannot be.

    Dask cannot be interrupted while they start without noise and orphans, so a thread starts them
    and an interrupted coordinator kills what was begun: then that thread ends by itself.
    """
    others = active_children()
    with ThreadPoolExecutor(1) as pool:
        # Ctrl-C reaches the whole process group, but only the coordinator may act on it: threads
        # and processes, also workers begun again later, inherit the mask of the one that made them.
        resource_tracker.ensure_running()  # now, for it unblocks SIGINT in whoever starts it
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        starting = pool.submit(_started, workers, decode_threads)
        try:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            try:
                cluster = starting.result()
            except (RuntimeError, OSError) as error:
                raise PipelineError(
                    f"extract.workers: {workers} worker processes could not be started "
                    f"({error.__cause__ or error}). One was killed, or ran out of memory as it "
                    "began: run the same command again, with fewer extract.workers where memory "
                    "is short, or with extract.workers=0."
                ) from None
            yield cluster
        finally:
            while not starting.done():
                for child in active_children():
                    if child not in others:
                        child.kill()
                time.sleep(_LOOK_EVERY_S)
            if starting.exception() is None:
                starting.result().close()


def _started(workers: int, decode_threads: int) -> LocalCluster:
    """One thread of each process has the model, the others prepare.

    A process that died is begun again however long its imports take (dask gives it up after 15 s).
    A task whose worker died is not tried again by the scheduler, but by us, alone.
    """
    cores = len(os.sched_getaffinity(0))
    threads = os.environ.get("OMP_NUM_THREADS") or str(max(1, cores // workers))
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    env: dict[str, str] = dict.fromkeys(names, threads)
    return private_cluster(workers, 1 + decode_threads, allowed_failures=0, env=env)
