"""dask schedulers: a private one for a single command, or one at a user's address.

Anyone who can reach a dask scheduler can run any code on its workers, as the user who started them.
"""

import logging
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import Any

import dask
from distributed import Client, LocalCluster
from distributed.security import Security

from pipeline.base.errors import ConfigError

TIMEOUT_S = 10
"""Time to reach a scheduler, and to reach it again after a lost connection."""


def private_cluster(
    workers: int, threads: int, allowed_failures: int = 3, env: Mapping[str, str] | None = None
) -> LocalCluster:
    """Worker processes on this machine that only this process can talk to.

    Every user of a machine can reach its loopback ports, so both ends of each connection need a
    certificate that is made here and never leaves these processes; there is no dashboard. No worker
    is restarted for its memory use, because a model may need most of the memory.
    """
    no_pages = {f"distributed.{who}.http.routes": [] for who in ("scheduler", "worker")}
    with dask.config.set(no_pages):
        return LocalCluster(
            n_workers=workers,
            threads_per_worker=threads,
            processes=True,
            security=Security.temporary(),
            memory_limit=0,
            dashboard_address="127.0.0.1:0",
            scheduler_kwargs={"allowed_failures": allowed_failures, "dashboard": False},
            silence_logs=logging.CRITICAL,
            env=dict(env or {}),
        )


def client_of(address: str, setting: str) -> Client:
    """A client of the scheduler at `address`, the value of `setting` in params.yaml.

    Raises `ConfigError` where no scheduler answers.
    """
    try:
        return Client(address, timeout=TIMEOUT_S, set_as_default=False)
    # tls:// without certificates is a TypeError; tcp:// where dask's config demands them is a
    # RuntimeError.
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise ConfigError(
            f"{setting}: no dask scheduler answers at {address}: {error}. Start one with "
            f"`dask scheduler` and workers with `dask worker`, or set {setting} to a number of "
            "processes on this machine. For a tls:// address see docs/machines.md."
        ) from None


@contextmanager
def quiet() -> Generator[None]:
    """Keep dask's log off stderr, because its errors are raised or printed here.

    asyncio's log too, in which dask reports that a process failed to start.
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
