"""Content digests of files, remembered by path, size and mtime.

A file is read once; while its size and modification time (ns) stay the same, its digest is looked
up. The ledger only saves reads: to lose it costs time, never correctness.
"""

import hashlib
import os
import sqlite3
from collections.abc import Callable
from contextlib import closing, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pipeline.base.documents import Border
from pipeline.base.errors import ConfigError, DiskFull, PipelineError, RecordingError, StoreLocked
from pipeline.base.files import described

LEDGER_SUFFIX = ".files.sqlite"
"""The suffix of a store's ledger of file digests."""
_APPLICATION = 0x564C4146
"""SQLite's `application_id` of a ledger, in bytes 68 to 71 of its header, big-endian."""

_TABLE = "known (key TEXT PRIMARY KEY, value BLOB)"
_ALL = "SELECT key, CAST(value AS BLOB) FROM known"
_DAMAGED = {
    sqlite3.SQLITE_ERROR,
    sqlite3.SQLITE_CORRUPT,
    sqlite3.SQLITE_FORMAT,
    sqlite3.SQLITE_NOTADB,
}
"""SQLite's errors that mean a damaged ledger."""
_FILE = Border(RecordingError, "Copy the file again, or leave its recording out.")


class ContentDigests:
    """Digests of files, kept in one SQLite file, or only in memory where `ledger` is None.

    Raises `ConfigError` where something else lies there or it cannot be written. A damaged ledger
    is replaced by an empty one; a damaged entry counts as missing.
    """

    def __init__(self, ledger: Path | None) -> None:
        self._ledger = ledger
        self._rows: dict[str, bytes] = {}
        """All entries: a query for each file would take longer than its `stat`."""
        self._database: sqlite3.Connection | None = None
        if ledger is not None:
            _refuse_foreign(ledger)
            ledger.parent.mkdir(parents=True, exist_ok=True)
            self._open(ledger)

    @classmethod
    def to_read(cls, ledger: Path) -> "ContentDigests":
        """The ledger, or a copy of it in memory where the file cannot be written.

        Raises `ConfigError` where something else lies there.
        """
        _refuse_foreign(ledger)
        with suppress(OSError, PipelineError):
            digests = cls(ledger)
            digests._query("DELETE FROM known WHERE 0")  # a file that may only be read refuses it
            return digests
        digests = cls(None)
        # immutable: otherwise sqlite creates files beside it.
        place = f"file:{quote(str(ledger.absolute()))}?mode=ro&immutable=1"
        with (
            suppress(sqlite3.DatabaseError, UnicodeDecodeError),  # it only saves reads
            closing(sqlite3.connect(place, uri=True)) as file,
        ):
            digests._rows = dict(file.execute(_ALL))
        return digests

    def _open(self, ledger: Path) -> None:
        try:
            self._database = sqlite3.connect(ledger, isolation_level=None)
        except sqlite3.OperationalError as error:
            raise self._unusable(error, error.sqlite_errorcode) from None
        if self._query("PRAGMA application_id") != [(_APPLICATION,)]:
            self._query(f"PRAGMA application_id = {_APPLICATION}")
        self._query("PRAGMA journal_mode = WAL")
        self._query("PRAGMA synchronous = OFF")
        self._query(f"CREATE TABLE IF NOT EXISTS {_TABLE}")
        self._rows = dict(self._query(_ALL) or ())

    def close(self) -> None:
        """Close the ledger."""
        if self._database is not None:
            self._database.close()

    def of(self, path: Path) -> str:
        """The `file_digest` of a file; reads the file if it is not known.

        Raises `RecordingError` when the file cannot be read.
        """
        with _FILE.foreign(path, "cannot be read"):
            try:
                status = path.stat()
            except FileNotFoundError:
                raise _FILE.refusal(path, "no such file") from None
            folder, name = os.path.split(path)
            identity = f"{status.st_size} {status.st_mtime_ns} {_real(folder)}/{name}"
            return self._recall_or_make("file", identity, lambda: file_digest(path))

    def note_rate(self, name: str, rows_per_s: float) -> None:
        """Remember how fast rows were computed, for later estimates."""
        self._remember("rate", name, str(rows_per_s))

    def rate(self, name: str) -> float | None:
        """Rows per second of the last session under that name; None if unknown."""
        rate = self._recall("rate", name)
        return None if rate is None else float(rate)

    def note_bad(self, episode: str, reason: str) -> None:
        """Remember that the episode with this digest cannot be used."""
        self._remember("bad", episode, reason)

    def bad(self, episode: str) -> str | None:
        """Why the episode with this digest cannot be used; None where nothing is known."""
        return self._recall("bad", episode)

    def text(self, name: str, make: Callable[[], str]) -> str:
        """The result of `make`, computed once; `name` must name all its inputs."""
        return self._recall_or_make("text", name, make)

    def _recall_or_make(self, kind: str, name: str, make: Callable[[], str]) -> str:
        value = self._recall(kind, name)
        if value is None:
            self._remember(kind, name, value := make())
        return value

    def _recall(self, kind: str, name: str) -> str | None:
        key = joint_digest(kind, name)
        text = (self._rows.get(key) or b"").decode("utf-8", "surrogateescape")
        checksum, value = text[:32], text[32:]
        return value if checksum == joint_digest(key, value) else None

    def _remember(self, kind: str, name: str, value: str) -> None:
        """Keep a value under the digest of its name, with a checksum before it."""
        key = joint_digest(kind, name)
        text = (joint_digest(key, value) + value).encode("utf-8", "surrogateescape")
        self._rows[key] = text
        self._query("INSERT OR REPLACE INTO known VALUES (?, ?)", key, text)

    def _query(self, statement: str, *values: object) -> list[Any] | None:
        """The result rows of a statement; None where the ledger is damaged, which is then replaced
        by an empty one."""
        if self._database is None or self._ledger is None:
            return None
        try:
            return self._database.execute(statement, values).fetchall()
        except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
            code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF
            if code not in _DAMAGED:
                raise self._unusable(error, code) from None
        self._database.close()
        for suffix in ("", "-wal", "-shm"):
            self._ledger.with_name(self._ledger.name + suffix).unlink(missing_ok=True)
        self._open(self._ledger)
        return None

    def _unusable(self, error: Exception, code: int) -> PipelineError:
        if code == sqlite3.SQLITE_BUSY:
            return StoreLocked(f"{self._ledger}: in use by another process; try again when it ends")
        if code == sqlite3.SQLITE_FULL:
            return DiskFull(f"{self._ledger}: {error}. Make room and run the same command again.")
        return ConfigError(
            f"{self._ledger}: cannot be written: {error}. Set extract.store to a folder that "
            "can be written to."
        )


@lru_cache(maxsize=1024)
def _real(folder: str) -> str:
    """The path of a folder without symbolic links."""
    return os.path.realpath(folder)


def ledger_path(store: Path) -> Path:
    """The ledger of a store's recordings and checkpoint, beside the store."""
    return store.with_name(f"{store.name}{LEDGER_SUFFIX}")


def is_ledger(path: Path) -> bool:
    """Whether a ledger, even a damaged one, or nothing lies at `path`.

    It does not look at SQLite's own files beside it. An unreadable file counts; opening it raises
    the error.
    """
    if not path.is_file():
        return not path.exists()
    try:
        with path.open("rb") as file:
            header = file.read(100)
    except OSError:
        return True
    if not header.startswith(b"SQLite format 3\0"):
        return not header
    return int.from_bytes(header[68:72], "big") == _APPLICATION


def _refuse_foreign(ledger: Path) -> None:
    if not is_ledger(ledger):
        raise ConfigError(
            f"{ledger}: expected nothing there or the content digests that this project keeps "
            f"there, found {described(ledger)} that it did not write. It was left as it is: move "
            "it away, or name another extract.store."
        )


def file_digest(path: Path) -> str:
    """The digest of a file's content, always read: 32 hex digits of BLAKE2b.

    Raises `RecordingError` unless it is a regular file.
    """
    _FILE.check_file(path)
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def joint_digest(*parts: str) -> str:
    """The digest of several texts in order, with clear boundaries between them: 32 hex digits."""
    hasher = hashlib.blake2b(digest_size=16)
    for part in parts:
        hasher.update(f"{len(part)}:".encode() + part.encode("utf-8", "surrogateescape"))
    return hasher.hexdigest()
