"""Content digests of files, remembered by path, size and mtime.

A file is read once; as long as its size and modification time (ns) stay, its digest is looked up.
The ledger only saves reading: losing it costs time, never correctness.
"""

import hashlib
import sqlite3
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pipeline.base.errors import (
    ConfigError,
    DiskFull,
    PipelineError,
    RecordingError,
    StoreLocked,
)
from pipeline.base.ownership import LEDGER_SUFFIX, described

_APPLICATION = 0x564C4146
"""SQLite's `application_id` of a ledger, in its header at bytes 68 to 71, big-endian."""

_TABLES = (
    "file (path TEXT PRIMARY KEY, size INTEGER, mtime_ns INTEGER, digest TEXT)",
    "rate (what TEXT PRIMARY KEY, rows_per_s REAL)",
    "bad (episode TEXT PRIMARY KEY, reason TEXT)",
    "text (what TEXT PRIMARY KEY, text TEXT)",
)


class ContentDigests:
    """Digests of files, kept in one SQLite file, or where that is None only in memory.

    Raises `ConfigError` where something else lies there or it cannot be written. A damaged ledger
    is begun anew.
    """

    def __init__(self, ledger: Path | None) -> None:
        self._ledger = ledger
        if ledger is None:
            return self._open()
        _refuse_foreign(ledger)
        try:
            ledger.parent.mkdir(parents=True, exist_ok=True)
            self._open()
        except sqlite3.DatabaseError as error:
            if error.sqlite_errorcode not in (sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT):
                raise self._unwritable(error) from None
            for suffix in ("", "-wal", "-shm"):
                ledger.with_name(ledger.name + suffix).unlink(missing_ok=True)
            self._open()

    @classmethod
    def to_read(cls, ledger: Path) -> "ContentDigests":
        """The ledger; where it cannot be written, what it knows, and nothing new is remembered.

        Removes nothing. Raises `ConfigError` where something else lies there.
        """
        _refuse_foreign(ledger)
        try:
            opened = cls(None)
            opened.close()
            opened._ledger = ledger
            ledger.parent.mkdir(parents=True, exist_ok=True)
            opened._open()
            opened._database.execute("DELETE FROM bad WHERE 0")
            return opened
        except (OSError, sqlite3.DatabaseError):
            known = cls(None)
            if ledger.is_file():
                with (
                    suppress(sqlite3.DatabaseError),  # it only saves reading
                    closing(_immutable(ledger)) as file,
                ):
                    file.backup(known._database)
            return known

    def _open(self) -> None:
        self._database = sqlite3.connect(self._ledger or ":memory:", isolation_level=None)
        try:
            if self._known("PRAGMA application_id", ()) != _APPLICATION:
                self._database.execute(f"PRAGMA application_id = {_APPLICATION}")
            self._database.execute("PRAGMA journal_mode = WAL")
            self._database.execute("PRAGMA synchronous = OFF")
            for table in _TABLES:
                self._database.execute(f"CREATE TABLE IF NOT EXISTS {table}")
        except sqlite3.DatabaseError:
            self._database.close()
            raise

    def close(self) -> None:
        """Close the ledger."""
        self._database.close()

    def of(self, path: Path) -> str:
        """The `file_digest` of a file, read where it is not known.

        Raises `RecordingError` when the file cannot be read.
        """
        try:
            place, status = str(path.resolve()), path.stat()
            known = self._known(
                "SELECT digest FROM file WHERE path = ? AND size = ? AND mtime_ns = ?",
                (place, status.st_size, status.st_mtime_ns),
            )
            if known:
                return known
            digest = file_digest(path)
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
        row = (place, status.st_size, status.st_mtime_ns, digest)
        self._write("INSERT OR REPLACE INTO file VALUES (?, ?, ?, ?)", row)
        return digest

    def note_rate(self, what: str, rows_per_s: float) -> None:
        """Remember how fast rows were computed, for the estimate of a later plan."""
        self._write("INSERT OR REPLACE INTO rate VALUES (?, ?)", (what, rows_per_s))

    def rate(self, what: str) -> float | None:
        """Rows a second of the last session under that name."""
        return self._known("SELECT rows_per_s FROM rate WHERE what = ?", (what,))

    def note_bad(self, episode: str, reason: str) -> None:
        """Remember that the episode of this digest cannot be used."""
        self._write("INSERT OR REPLACE INTO bad VALUES (?, ?)", (episode, reason))

    def bad(self, episode: str) -> str | None:
        """Why the episode of this digest cannot be used; None where nothing is known."""
        return self._known("SELECT reason FROM bad WHERE episode = ?", (episode,))

    def text(self, what: str, make: Callable[[], str]) -> str:
        """What `make` gives, made once: `what` names everything that it depends on."""
        known = self._known("SELECT text FROM text WHERE what = ?", (what,))
        if known is not None:
            return known
        made = make()
        self._write("INSERT OR REPLACE INTO text VALUES (?, ?)", (what, made))
        return made

    def _known(self, query: str, values: tuple[object, ...]) -> Any:
        """The one value that a query finds; None where it finds nothing."""
        row = self._database.execute(query, values).fetchone()
        return row[0] if row else None

    def _write(self, statement: str, values: tuple[object, ...]) -> None:
        try:
            self._database.execute(statement, values)
        except sqlite3.OperationalError as error:
            raise self._unwritable(error) from None

    def _unwritable(self, error: sqlite3.DatabaseError) -> PipelineError:
        if error.sqlite_errorcode == sqlite3.SQLITE_BUSY:
            return StoreLocked(f"{self._ledger}: in use by another process; try again when it ends")
        if error.sqlite_errorcode == sqlite3.SQLITE_FULL:
            return DiskFull(f"{self._ledger}: {error}. Make room and run the same command again.")
        return ConfigError(
            f"{self._ledger}: cannot be written: {error}. Set extract.store to a folder that "
            "can be written to."
        )


def ledger_path(store: Path) -> Path:
    """Where the digests of a store's recordings and checkpoint are remembered: beside it."""
    return store.with_name(f"{store.name}{LEDGER_SUFFIX}")


def is_ledger(path: Path) -> bool:
    """Whether content digests, a damaged file of them too, or nothing at all lies there.

    Looks without SQLite's own files beside it. What cannot be read is left to who opens it.
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
    if application := int.from_bytes(header[68:72], "big"):
        return application == _APPLICATION
    try:  # of an earlier version, which left no application's id
        with closing(_immutable(path)) as file:
            made = {row[0] for row in file.execute("SELECT sql FROM sqlite_master")}
    except sqlite3.DatabaseError:
        return True
    return not made or any("TABLE file (path TEXT" in str(text) for text in made)


def _refuse_foreign(ledger: Path) -> None:
    if not is_ledger(ledger):
        raise ConfigError(
            f"{ledger}: expected nothing there or the content digests that this project keeps "
            f"there, found {described(ledger)} that it did not write. It was left as it is: move "
            "it away, or name another extract.store."
        )


def _immutable(path: Path) -> sqlite3.Connection:
    """A database to read, with no file made beside it, as sqlite else would."""
    return sqlite3.connect(f"file:{quote(str(path.absolute()))}?immutable=1", uri=True)


def file_digest(path: Path) -> str:
    """The digest of a file's content, read anew: 32 hex digits of BLAKE2b."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def joint_digest(*parts: str) -> str:
    """The digest of several texts in this order, each told from its neighbours: 32 hex digits."""
    hasher = hashlib.blake2b(digest_size=16)
    for part in parts:
        hasher.update(f"{len(part)}:".encode() + part.encode())
    return hasher.hexdigest()
