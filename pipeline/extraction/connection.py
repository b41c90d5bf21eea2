"""Reach the dask workers that compute rows: processes of this host, or those of a scheduler."""

import logging
import os
import signal
import sys
import time
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, resource_tracker
from typing import Any

import dask
from distributed import Client, LocalCluster

from pipeline.config import ExtractParams
from pipeline.errors import ConfigError, PipelineError

_TIMEOUT_S = 10
"""For reaching a scheduler, and for reaching it again when the connection is lost."""

_LOOK_EVERY_S = 0.05


def check_scheduler(extract: ExtractParams) -> None:
    """Raise `ConfigError` where `extract.workers` is an address at which no scheduler answers."""
    if isinstance(extract.workers, str):
        with _quiet(), _client_of(extract.workers):
            pass


@contextmanager
def connected(extract: ExtractParams) -> Generator[Client]:
    """A client of `extract.workers`; local processes end with it.

    Raises `ConfigError` where no scheduler answers at the address, `PipelineError` where local
    processes cannot be started.
    """
    with _quiet():
        if isinstance(extract.workers, int):
            with (
                dask.config.set({"distributed.deploy.lost-worker-timeout": "1h"}),
                _local_cluster(extract.workers, extract.decode_threads) as cluster,
                Client(cluster, set_as_default=False) as client,
            ):
                yield client
        else:
            with _client_of(extract.workers) as client:
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
    No worker is restarted for its memory (a model may take most of it), and a task whose worker
    died is not tried again by the scheduler, but by us, alone.
    """
    cores = len(os.sched_getaffinity(0))
    threads = os.environ.get("OMP_NUM_THREADS") or str(max(1, cores // workers))
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    return LocalCluster(
        n_workers=workers,
        threads_per_worker=1 + decode_threads,
        processes=True,
        memory_limit=0,
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
        scheduler_kwargs={"allowed_failures": 0},
        env=dict.fromkeys(names, threads),
    )


def _client_of(address: str) -> Client:
    try:
        return Client(address, timeout=_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"extract.workers: no dask scheduler answers at {address}: {error}. Start one with "
            "`dask scheduler` and workers with `dask worker`, or set extract.workers to a number "
            "of processes on this machine."
        ) from None


@contextmanager
def _quiet() -> Generator[None]:
    """Keep dask's log off stderr: what matters of it is raised, or said by us.

    That of asyncio, too: dask leaves the failures of processes that never came up to it.
    """
    loggers: list[Any] = [logging.getLogger(name) for name in ("distributed", "tornado", "asyncio")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
