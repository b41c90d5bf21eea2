"""Whether what is looked at of a store is what was written."""

from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import StoreIncomplete
from pipeline.evaluation import place
from pipeline.store import FEATURES, FeatureStore
from pipeline.store.chunks import ChunkFiles, row_checksums
from pipeline.store.gather import WIDE
from pipeline.store.mending import extract_command, mend
from pipeline.store.metadata import check_metadata
from pipeline.store.schema import read_specs

_BLOCK_BYTES = 2**24


def open_checked(path: Path) -> FeatureStore:
    """A finished store with something in it, of which all but the wide arrays is as it was written.

    Metadata and every array of a few bytes a tick or row are read whole, as all that is said of a
    store rests on them. Raises `StoreIncomplete` where one is damaged.
    """
    if path.name.endswith(".part"):  # which looks like a store until its files are read
        finished = path.with_name(path.name.split(".zarr")[0] + ".zarr")
        raise StoreIncomplete(
            f"{path}: expected a finished store, found an unfinished build. Complete it with "
            f"{extract_command(finished)}."
        )
    store = FeatureStore.open(path)
    check_metadata(path)
    for name, spec in read_specs(path).items():
        if name not in WIDE.values():
            with closing(ChunkFiles(path, spec, writable=False)) as files:
                files.check()
    if not len(store.array("vl/time")):
        raise StoreIncomplete(
            f"{path}: expected VL rows to look at, found none. Run {extract_command(path)}."
        )
    return store


def check_rows(store: FeatureStore, rows: NDArray[np.int64]) -> None:
    """Raise `StoreIncomplete` where one of these feature rows does not give its checksum."""
    features, wanted = store.array(FEATURES), store.array("vl/checksum")
    step = max(1, _BLOCK_BYTES // features[:1].nbytes)
    for start in range(0, len(rows), step):
        block = rows[start : start + step]
        bad = block[row_checksums(features[block]) != wanted[block]]
        if len(bad):
            raise StoreIncomplete(
                f"{store.path}: expected features that give their checksum, found {len(bad)} VL "
                f"row(s) that do not, the first {place(store, 'vl', int(bad[0]))}: the store is "
                f"damaged. {mend(store.path)}"
            )
