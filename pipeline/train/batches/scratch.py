"""A store restored from its archive to a scratch folder, once."""

import fcntl
import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

from pipeline.base.durable import free_bytes
from pipeline.base.errors import DiskFull
from pipeline.base.format import size
from pipeline.store.archive import restore
from pipeline.store.archive.manifest import Manifest, read_manifest

_KEY_LETTERS = 16
_MARGIN_BYTES = 64 * 2**20
"""For metadata, trailers and padded chunks."""


def restored(archive: Path, scratch: Path | None, say: Callable[[str], None]) -> Path:
    """The store that an archive holds, in `scratch`: the one that is there, else restored now.

    Its name has a digest of its content, so that another archive of the same store finds it, and an
    archive that was made anew does not. Of several processes that ask at a time one restores, and
    the others wait. Raises `DiskFull` before anything is written where it does not fit, and
    `StoreIncomplete` where the archive is damaged.
    """
    manifest = read_manifest(archive)
    folder = _default_scratch() if scratch is None else scratch
    target = folder / f"{archive.name.split('.')[0]}-{_key(manifest)}.zarr"
    with _one_at_a_time(target):
        if target.exists():
            say(f"feed: compressed: {archive} is an archive; its store is still in {target}")
            return target
        needed = sum(array.raw_bytes for array in manifest.arrays.values()) + _MARGIN_BYTES
        free = free_bytes(folder)
        if free < needed:
            raise DiskFull(
                f"{folder}: expected {size(needed)} for the store of {archive}, found "
                f"{size(free)} free. Make room (stores restored earlier lie there too), "
                "or set train_head.scratch to a folder on a larger disk."
            )
        say(f"feed: compressed: {archive} is an archive; restoring its store to {target}")
        restore(archive, target, threads=os.cpu_count() or 1)
    return target


def _key(manifest: Manifest) -> str:
    """Names the content of the store: its metadata and the checksum of each of its chunks."""
    checksums = {name: array.crc32c for name, array in manifest.arrays.items()}
    said = json.dumps([dict(manifest.metadata), checksums], sort_keys=True)
    return hashlib.blake2b(said.encode()).hexdigest()[:_KEY_LETTERS]


def _default_scratch() -> Path:
    """Of this user alone: another user's store could not be told from one's own."""
    return Path(tempfile.gettempdir()) / f"feature-stores-{os.getuid()}"


@contextmanager
def _one_at_a_time(target: Path) -> Generator[None]:
    """Wait until no other process restores this store; the kernel ends the wait if it dies."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with target.with_name(f"{target.name}.wait").open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
