"""A lock that allows one builder per store and ends with its process."""

import errno
import fcntl
import os
import re
import socket
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from pipeline.base.documents import Border
from pipeline.base.errors import ConfigError, StoreLocked
from pipeline.base.files import there

_LOCK = Border(
    ConfigError, "It was left as it is: move it away, or name another place for what it locks."
)
_NO_FLOCK = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK)


@contextmanager
def build_lock(target: Path) -> Generator[None]:
    """Hold `<name>.zarr.lock` beside the store.

    The kernel releases it when the process ends in any way. Raises `StoreLocked`, which names the
    process that holds the lock, and `ConfigError` where the file is not a lock of this project.
    """
    path = target.with_name(target.name + ".lock")
    path.parent.mkdir(parents=True, exist_ok=True)
    if there(path):  # also a dangling link, which would create a file elsewhere
        _LOCK.check_file(path, 1000)
    with path.open("a+", encoding="utf-8", errors="replace") as file:
        file.seek(0)
        holder = file.read().strip()
        if holder and not re.fullmatch(r"process \d+ on \S+", holder):
            why = "expected a lock, found a file that this project did not write"
            raise _LOCK.refusal(path, why)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StoreLocked(
                f"{target}: being built by {holder or 'another process'} ({path}). Wait for it or "
                f"stop it, then run the same command again; or name another place than {target}."
            ) from None
        except OSError as error:
            if error.errno not in _NO_FLOCK:
                raise
            what = "this file system has no locks: start no second run on this store"
            print(f"{path}: {what}", file=sys.stderr)
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        try:
            yield
        finally:
            file.truncate(0)


def is_locked(target: Path) -> bool:
    """Whether a process holds the lock of a store."""
    path = target.with_name(target.name + ".lock")
    if not path.is_file():
        return False
    with path.open("rb") as file:
        try:
            # A shared lock, so that two readers do not take each other for a builder.
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError as error:
            return isinstance(error, BlockingIOError)
        return False
