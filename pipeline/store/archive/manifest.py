"""What an archive says of itself: enough to check it and to rebuild the store to the byte.

It stands in the attributes of the archive's root group, beside the attributes of the store, and
is written last: a folder with a manifest is a complete archive.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pipeline.base.errors import StoreIncomplete, StoreMismatch
from pipeline.base.ownership import OutputKind

ARCHIVE_SCHEMA = 1
ATTRIBUTE = "archive"
ROOT = "zarr.json"


@dataclass(frozen=True)
class ArchivedArray:
    """One array of an archive."""

    codec: str
    ratios: Mapping[str, float | None]
    """What each candidate made of the samples."""
    raw_bytes: int
    """Of its rows."""
    shard_bytes: tuple[int, ...]
    """Size of each shard's file; 0 where all is zero, for which zarr writes no file."""
    crc32c: tuple[int, ...]
    """Checksum of the data of each chunk file of the store, in order."""
    metadata: str
    """Digest of this array's metadata in the archive."""

    @classmethod
    def of(cls, said: Mapping[str, Any]) -> "ArchivedArray":
        """What `document` wrote of it."""
        fields: dict[str, Any] = dict(said)
        for name in ("shard_bytes", "crc32c"):
            fields[name] = tuple(fields[name])
        return cls(**fields)

    @property
    def stored_bytes(self) -> int:
        """Bytes of all shards."""
        return sum(self.shard_bytes)


@dataclass(frozen=True)
class Manifest:
    """The content of an archive."""

    metadata: Mapping[str, str]
    """Every `zarr.json` of the store, as text, by its path."""
    arrays: Mapping[str, ArchivedArray]

    @property
    def plan(self) -> str | None:
        """The plan of the store."""
        return json.loads(self.metadata[ROOT])["attributes"].get("plan")

    def document(self) -> dict[str, Any]:
        """The manifest as JSON, with a digest of itself."""
        body = {
            "schema": ARCHIVE_SCHEMA,
            "metadata": dict(self.metadata),
            "arrays": {name: asdict(array) for name, array in self.arrays.items()},
        }
        return {**body, "digest": _digest_of(body)}


def is_archive(path: Path) -> bool:
    """Whether a complete archive lies there; reads the group's metadata only."""
    return _document(path) is not None


ARCHIVE = OutputKind("an archive of a store", is_archive)


def read_manifest(path: Path) -> Manifest:
    """The manifest of an archive.

    Raises `StoreMismatch` where there is something else and `StoreIncomplete` where it is
    damaged.
    """
    document = _document(path)
    if document is None:
        found = "something else" if path.exists() else "nothing"
        raise StoreMismatch(
            f"{path}: expected an archive, found {found}. Name one with archive.output, or make "
            "it with stages.archive."
        )
    if document.get("schema") != ARCHIVE_SCHEMA:
        raise StoreMismatch(
            f"{path}: expected an archive of schema {ARCHIVE_SCHEMA}, found "
            f"{document.get('schema')!r}. Restore it with the version that made it."
        )
    if document.pop("digest", None) != _digest_of(document):
        raise damaged(path / ROOT, "its manifest does not give its digest")
    arrays = {name: ArchivedArray.of(said) for name, said in document["arrays"].items()}
    return Manifest(document["metadata"], arrays)


def read_metadata(store: Path) -> dict[str, str]:
    """Every `zarr.json` of a store as text, by its path in it."""
    paths = sorted(store.rglob(ROOT))
    return {path.relative_to(store).as_posix(): path.read_bytes().decode() for path in paths}


def file_digest(path: Path) -> str:
    """BLAKE2b of a small file."""
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()


def damaged(path: Path, why: str) -> StoreIncomplete:
    """What is said of a file of an archive that is not as it was written."""
    return StoreIncomplete(
        f"{path}: the archive is damaged: {why}. Nothing was restored from it; take another copy "
        "of the archive, or make it anew with stages.archive where the store still is."
    )


def _document(path: Path) -> dict[str, Any] | None:
    try:
        attributes = json.loads((path / ROOT).read_text(encoding="utf-8"))["attributes"]
        found = attributes[ATTRIBUTE]
    except (FileNotFoundError, NotADirectoryError, ValueError, KeyError, TypeError):
        return None
    return found if isinstance(found, dict) else None


def _digest_of(body: Mapping[str, Any]) -> str:
    text = json.dumps(body, sort_keys=True, ensure_ascii=False)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
