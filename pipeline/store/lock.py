"""A lock that allows one builder per store and ends with its process."""

import errno
import fcntl
import os
import re
import socket
import sys
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from pipeline.base.border import Border
from pipeline.base.errors import ConfigError, StoreLocked
from pipeline.base.files import there

_BEAT_S = 10.0
"""How often the holder renews the file's time as a sign of life."""

_STALE_S = 60.0
"""A holder on another host counts as dead after this long without a sign of life."""

_HELD = re.compile(r"process \d{1,20} on \S{1,255}")

_LOCK = Border(
    ConfigError, "It was left as it is: move it away, or name another place for what it locks."
)

_NO_FLOCK = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK)


@contextmanager
def build_lock(target: Path) -> Generator[None]:
    """Hold `<name>.zarr.lock` beside the store.

    The kernel releases it when the process ends in any way, so a file that a dead process of this
    host left behind does not block. On a shared file system flock may work only within each host,
    or not at all: then the holder's name and the file's time, renewed every 10 s, count for a
    minute. Raises `StoreLocked`, which names the process that holds the lock, and `ConfigError`
    where the file is not a lock of this project.
    """
    path = target.with_name(target.name + ".lock")
    path.parent.mkdir(parents=True, exist_ok=True)
    if there(path):  # also a dangling link, which would create a file elsewhere
        _LOCK.check_file(path, 1000)
    with path.open("a+", encoding="utf-8", errors="replace") as file:
        locked, holder, elsewhere = _look(file, path, fcntl.LOCK_EX)
        message = (
            f"{target}: being built by {holder or 'another process'} ({path}). Wait for it or stop "
            f"it, then run the same command again; or name another place than {target}."
        )
        if locked is False:
            raise StoreLocked(message)
        if not path.exists() or path.stat().st_ino != os.fstat(file.fileno()).st_ino:
            # The file was removed before it was locked, so that this lock excludes nobody.
            raise StoreLocked(f"{path}: removed by another process just now; run the same again.")
        if elsewhere and (age_s := _age_s(file)) < _STALE_S:
            raise StoreLocked(
                f"{message} It gave a sign of life {age_s:.0f} s ago; if it was killed, wait until "
                f"that is {_STALE_S:.0f} s."
            )
        if locked is None:
            what = "this file system has no locks: two builds begun at once do not see each other"
            print(f"{path}: {what}", file=sys.stderr)
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        try:
            with _signs_of_life(file):
                yield
        finally:
            file.truncate(0)  # empty means released, so nobody waits


def lock_holder(path: Path) -> str | None:
    """The process named in a lock file; None where no living process holds it.

    The kernel may not show a lock of another host. Such a holder counts as alive for a minute after
    its last sign of life, as in `build_lock`.
    """
    _LOCK.check_file(path, 1000)
    with path.open("r", encoding="utf-8", errors="replace") as file:
        # A shared lock, so that two readers do not take each other for a builder.
        locked, holder, elsewhere = _look(file, path, fcntl.LOCK_SH)
        age_s = abs(time.time() - path.stat().st_mtime)
        alive = locked is False or (elsewhere and age_s < _STALE_S)
    return (holder or "another process") if alive else None


def _look(file: TextIO, path: Path, how: int) -> tuple[bool | None, str, bool]:
    """Whether the lock was taken, the holder's name in the file, whether it may be on another host.

    The first is None where the file system has no locks. Raises `ConfigError` where the file is not
    a lock of this project.
    """
    locked: bool | None = True
    try:
        fcntl.flock(file, how | fcntl.LOCK_NB)
    except BlockingIOError:
        locked = False
    except OSError as error:
        if error.errno not in _NO_FLOCK:
            raise
        locked = None
    file.seek(0)
    holder = file.read().strip()
    if holder and not _HELD.fullmatch(holder):
        raise _LOCK.refusal(path, "expected a lock, found a file that this project did not write")
    here = holder.endswith(f" on {socket.gethostname()}")
    return locked, holder, bool(holder) and not (locked and here)


def _age_s(file: TextIO) -> float:
    """Seconds since the file's time, by the clock of the file's host; leaves the time unchanged.

    A time in the future is set to the present: if its holder is dead, it is then noticed a minute
    later, not only when the clock reaches that time.
    """
    seen = os.fstat(file.fileno()).st_mtime_ns
    os.utime(file.fileno())
    age_s = (os.fstat(file.fileno()).st_mtime_ns - seen) / 1e9
    if age_s < 0:
        return 0.0
    os.utime(file.fileno(), ns=(seen, seen))
    return age_s


@contextmanager
def _signs_of_life(file: TextIO) -> Generator[None]:
    """Renew the file's time in the background."""
    ended = threading.Event()

    def beat() -> None:
        while not ended.wait(_BEAT_S):
            os.utime(file.fileno())

    thread = threading.Thread(target=beat, name="lock", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
