"""A compressed, sharded, checksummed copy of a store, for keeping and sharing.

A plain zarr v3 group of the same arrays under the same names, but in few, large files (shards), in
which inner chunks of some MB are compressed and checksummed one by one, so that a part can be read
without the whole. `copying` writes it, `restoration` makes the store from it again, to the byte;
`source` reads the store, `layout` cuts arrays into shards. What it says of itself is
`pipeline.store.archive.manifest`.
"""

from pipeline.store.archive.copying import archive
from pipeline.store.archive.manifest import is_archive
from pipeline.store.archive.report import ArchiveReport
from pipeline.store.archive.restoration import restore

__all__ = ["ArchiveReport", "archive", "is_archive", "restore"]
