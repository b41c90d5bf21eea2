"""What an archive says of itself: enough to prove it and to rebuild the store to the byte.

The manifest stands in the attributes of the archive's root group, beside those of the store, and is
written last: a folder that has one is a complete archive.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from pipeline.base.errors import StoreIncomplete, StoreMismatch
from pipeline.base.ownership import OutputKind
from pipeline.base.table import Table

ARCHIVE_SCHEMA = 1
ZARR_JSON = "zarr.json"
MANIFEST = "archive"
"""The attribute of the root that holds the manifest."""
_SMALL = 0.01
"""Share of the bytes up to which an array has no line: of a tiny one, padding makes the ratio."""


class ArchivedArray(BaseModel, frozen=True):
    """What the manifest says of one array."""

    codec: str
    ratios: dict[str, float | None] = {}
    """What each codec made of samples, where an earlier version chose among several."""
    raw_bytes: int
    """Of its rows."""
    shard_bytes: tuple[int, ...]
    """Size of each shard's file; 0 where all is zero, for which zarr writes no file."""
    crc32c: tuple[int, ...]
    """Checksum of the data of each chunk file of the store, in order."""
    metadata: str
    """Digest of this array's metadata in the archive."""


class Manifest(BaseModel, frozen=True):
    """The content of an archive."""

    metadata: dict[str, str]
    """Every `zarr.json` of the store, as text, by its path."""
    arrays: dict[str, ArchivedArray]

    @property
    def plan(self) -> str | None:
        """The plan of the store."""
        return json.loads(self.metadata[ZARR_JSON])["attributes"].get("plan")

    @property
    def raw_bytes(self) -> int:
        """Of the rows of all arrays."""
        return sum(array.raw_bytes for array in self.arrays.values())

    @property
    def stored_bytes(self) -> int:
        """Of all shards."""
        return sum(sum(array.shard_bytes) for array in self.arrays.values())

    def table(self) -> Table:
        """The large arrays: size, how much smaller they became, codec; then all of them."""
        listed = [
            (name, array.raw_bytes, sum(array.shard_bytes), array.codec)
            for name, array in self.arrays.items()
            if array.raw_bytes > _SMALL * self.raw_bytes
        ]
        listed.append(("all", self.raw_bytes, self.stored_bytes, ""))
        rows = [
            (name, raw / 1e6, raw / stored if stored else None, codec)  # zeros take no shard
            for name, raw, stored, codec in listed
        ]
        return Table(("array", "MB", "ratio", "codec"), rows)

    def document(self) -> dict[str, Any]:
        """The manifest as JSON, with a digest of itself."""
        body = {"schema": ARCHIVE_SCHEMA, **self.model_dump(mode="json")}
        return {**body, "digest": _digest_of(body)}


def is_archive(path: Path) -> bool:
    """Whether a complete archive lies there; reads the group's metadata only."""
    return _manifest_document(path) is not None


ARCHIVE = OutputKind("an archive of a store", is_archive)


def read_manifest(path: Path) -> Manifest:
    """The manifest of an archive.

    Raises `StoreMismatch` where there is something else, `StoreIncomplete` where it is damaged.
    """
    document = _manifest_document(path)
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
        raise damaged(path / ZARR_JSON, "its manifest does not give its digest")
    return Manifest.model_validate(document)


def _manifest_document(path: Path) -> dict[str, Any] | None:
    try:
        attributes = json.loads((path / ZARR_JSON).read_text(encoding="utf-8"))["attributes"]
        document = attributes[MANIFEST]
    except (FileNotFoundError, NotADirectoryError, ValueError, KeyError, TypeError):
        return None
    return document if isinstance(document, dict) else None


def _digest_of(body: Mapping[str, Any]) -> str:
    text = json.dumps(body, sort_keys=True, ensure_ascii=False)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def damaged(path: Path, why: str) -> StoreIncomplete:
    """The error for a file of an archive that is not as it was written."""
    return StoreIncomplete(
        f"{path}: the archive is damaged: {why}. Nothing was restored from it; take another copy "
        "of the archive, or make it anew with stages.archive where the store still is."
    )
