"""One builder a store: a lock that dies with its process."""

import fcntl
import os
import socket
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from pipeline.errors import StoreLocked


@contextmanager
def build_lock(target: Path) -> Generator[None]:
    """Hold `<name>.zarr.lock` beside the store.

    The kernel releases it when the process ends, however it ends, so a left-over lock file means
    nothing. Raises `StoreLocked` naming the process that holds it.
    """
    path = target.with_name(target.name + ".lock")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise StoreLocked(
                f"{target}: being built by {file.read().strip() or 'another process'} ({path}). "
                "Wait for it or stop it, then run the same command again."
            ) from None
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        yield
