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

from pipeline.base.errors import ConfigError, StoreLocked

_BEAT_S = 10.0
"""How often the holder shows that it lives."""

_STALE_S = 60.0
"""Without a sign of life for so long, a holder on another host is dead."""

_HELD = re.compile(r"process \d+ on ")

_NO_FLOCK = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK)


@contextmanager
def build_lock(target: Path) -> Generator[None]:
    """Hold `<name>.zarr.lock` beside the store.

    The kernel releases it when the process ends, however it ends, so what a dead process of this
    host left behind means nothing. A shared file system may keep flock to each host, or not have
    it: there the holder's name and the time of the file, renewed every 10 s, are believed for a
    minute. Raises `StoreLocked` naming the process that holds it.
    """
    path = target.with_name(target.name + ".lock")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+", encoding="utf-8") as file:
        alone_here = _flocked(file, target, path)
        _refuse_removed(file, path)
        _refuse_living(file, target, path, alone_here)
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
    with path.open("r", encoding="utf-8") as file:
        try:
            # Shared, so that two that ask do not take each other for a builder.
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            held = False
        except OSError:
            held = True
        holder = _holder(file)
        here = not holder or holder.endswith(f" on {socket.gethostname()}")
        alive = held or (not here and time.time() - path.stat().st_mtime < _STALE_S)
    return (holder or "another process") if alive else None


def _flocked(file: TextIO, target: Path, path: Path) -> bool:
    """Take the kernel's lock; False, said on stderr, where the file system has none."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise StoreLocked(_held(target, path, _holder(file))) from None
    except OSError as error:
        if error.errno not in _NO_FLOCK:
            raise
        print(
            f"{path}: this file system has no locks ({error.strerror}); two builds begun within "
            "the same instant would not see each other",
            file=sys.stderr,
        )
        return False
    return True


def _refuse_removed(file: TextIO, path: Path) -> None:
    """Raise where the file was tidied away before it was locked: a lock on it excludes nobody."""
    if not path.exists() or path.stat().st_ino != os.fstat(file.fileno()).st_ino:
        raise StoreLocked(f"{path}: removed by another process just now; run the same again.")


def _refuse_living(file: TextIO, target: Path, path: Path, alone_here: bool) -> None:
    """Raise where another host's process, or one that flock cannot see, gave a sign of life."""
    holder = _holder(file)
    if holder and not _HELD.match(holder):
        raise ConfigError(
            f"{path}: expected the lock of {target}, found a file that this project did not write. "
            f"It was left as it is: move it away, or name another place than {target}."
        )
    ours = holder.endswith(f" on {socket.gethostname()}")
    if not holder or (ours and alone_here):
        return
    seen = os.fstat(file.fileno()).st_mtime_ns
    os.utime(file.fileno())  # both times by the clock of the file's own host
    age_s = (os.fstat(file.fileno()).st_mtime_ns - seen) / 1e9
    if age_s < _STALE_S:
        os.utime(file.fileno(), ns=(seen, seen))
        raise StoreLocked(
            f"{_held(target, path, holder)} It gave a sign of life {age_s:.0f} s ago; if it was "
            f"killed, wait until that is {_STALE_S:.0f} s."
        )


def _holder(file: TextIO) -> str:
    file.seek(0)
    return file.read().strip()


def _held(target: Path, path: Path, holder: str) -> str:
    return (
        f"{target}: being built by {holder or 'another process'} ({path}). Wait for it or stop it, "
        "then run the same command again."
    )


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
