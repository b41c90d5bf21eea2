"""Reach the dask workers that compute rows: processes of this host, or those of a scheduler."""

import logging
import os
import sys
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import dask
from distributed import Client, LocalCluster

from pipeline.config import ExtractParams
from pipeline.errors import ConfigError

_TIMEOUT_S = 10
"""For reaching a scheduler, and for reaching it again when the connection is lost."""


@contextmanager
def connected(extract: ExtractParams) -> Generator[Client]:
    """A client of `extract.workers`; local processes end with it.

    Raises `ConfigError` where no scheduler answers at the address.
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
                yield client


def _local_cluster(workers: int, decode_threads: int) -> LocalCluster:
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
        client = Client(address, timeout=_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"extract.workers: no dask scheduler answers at {address}: {error}. Start one with "
            "`dask scheduler` and workers with `dask worker`, or set extract.workers to a number "
            "of processes on this machine."
        ) from None
    if not client.nthreads():
        print(f"{address}: the scheduler has no worker yet; waiting for one", file=sys.stderr)
    return client


@contextmanager
def _quiet() -> Generator[None]:
    """Keep dask's log off stderr: what matters of it is raised, or said by us."""
    loggers: list[Any] = [logging.getLogger(name) for name in ("distributed", "tornado")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
