"""One builder a store: a lock that dies with its process."""

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
"""How often the holder shows that it lives."""

_STALE_S = 60.0
"""Without a sign of life for so long, a holder on another host is dead."""

_HELD = re.compile(r"process \d{1,20} on \S{1,255}")

_LOCK = Border(
    ConfigError, "It was left as it is: move it away, or name another place for what it locks."
)

_NO_FLOCK = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK)


@contextmanager
def build_lock(target: Path) -> Generator[None]:
    """Hold `<name>.zarr.lock` beside the store.

    The kernel releases it when the process ends, however it ends, so what a dead process of this
    host left behind means nothing. A shared file system may keep flock to each host, or not have
    it: there the holder's name and the time of the file, renewed every 10 s, are believed for a
    minute. Raises `StoreLocked` naming the process that holds it, `ConfigError` where the file is
    none of this project's.
    """
    path = target.with_name(target.name + ".lock")
    path.parent.mkdir(parents=True, exist_ok=True)
    if there(path):  # a link to nothing too, through which a file would be made elsewhere
        _LOCK.check_file(path, 1000)
    with path.open("a+", encoding="utf-8", errors="replace") as file:
        locked, holder, elsewhere = _look(file, path, fcntl.LOCK_EX)
        held = (
            f"{target}: being built by {holder or 'another process'} ({path}). Wait for it or stop "
            f"it, then run the same command again; or name another place than {target}."
        )
        if locked is False:
            raise StoreLocked(held)
        if not path.exists() or path.stat().st_ino != os.fstat(file.fileno()).st_ino:
            # Tidied away before it was locked: a lock on it excludes nobody.
            raise StoreLocked(f"{path}: removed by another process just now; run the same again.")
        if elsewhere and (age_s := _age_s(file)) < _STALE_S:
            raise StoreLocked(
                f"{held} It gave a sign of life {age_s:.0f} s ago; if it was killed, wait until "
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
            file.truncate(0)  # an empty one was left by its holder: nobody need wait for it


def lock_holder(path: Path) -> str | None:
    """Who holds a lock file, as it says; None where no living process does.

    A holder on another host, whose lock the kernel may not show here, is believed for a minute
    after its last sign of life, as `build_lock` believes it.
    """
    _LOCK.check_file(path, 1000)
    with path.open("r", encoding="utf-8", errors="replace") as file:
        # Shared, so that two that ask do not take each other for a builder.
        locked, holder, elsewhere = _look(file, path, fcntl.LOCK_SH)
        age_s = abs(time.time() - path.stat().st_mtime)
        alive = locked is False or (elsewhere and age_s < _STALE_S)
    return (holder or "another process") if alive else None


def _look(file: TextIO, path: Path, how: int) -> tuple[bool | None, str, bool]:
    """Whether the kernel's lock was to be had, who holds it as the file says, and whether that may
    be a process of another host.

    None where the file system has no locks. Raises `ConfigError` where the file is no lock.
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
    """Seconds since the file's time by the clock of its own host; the time stays as it is.

    One that lies ahead of that clock is no sign of life: it becomes the present, so that a holder
    that shows none from now on is dead a minute later, not when the clock gets there.
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
