"""Whether what is looked at of a store is what was written."""

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import StoreIncomplete
from pipeline.store import FEATURES, FeatureStore, place
from pipeline.store.chunks import ChunkFiles, row_checksums
from pipeline.store.gather import WIDE
from pipeline.store.metadata import check_metadata
from pipeline.store.repair_hints import extract_command, mend
from pipeline.store.schema import read_specs

_BLOCK_BYTES = 2**24
_BFLOAT16_EXPONENT = 0x7F80
"""All of its bits are set in what is infinite or not a number."""


def open_checked(path: Path) -> FeatureStore:
    """A finished store with something in it, of which all but the wide arrays is as it was written.

    Metadata and every array of a few bytes a tick or row are read whole, as all that is said of a
    store rests on them. Raises `StoreIncomplete` where one is damaged.
    """
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


def check_rows(store: FeatureStore, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(row, slot) whether the features of these VL rows are no numbers where the slot is valid.

    Slots of all variants. Raises `StoreIncomplete` where a row does not give its checksum.
    """
    features, wanted = store.array(FEATURES), store.array("vl/checksum")
    valid = store.array("vl/slot_valid")
    broken = np.zeros((len(rows), features.shape[1]), np.bool_)
    step = max(1, _BLOCK_BYTES // features[:1].nbytes)
    for start in range(0, len(rows), step):
        block = rows[start : start + step]
        values = features[block]
        broken[start : start + step] = ~_finite(values).all(axis=2) & (valid[block] != 0)
        bad = block[row_checksums(values) != wanted[block]]
        if len(bad):
            raise StoreIncomplete(
                f"{store.path}: expected features that give their checksum, found {len(bad)} VL "
                f"row(s) that do not, the first {place(store, 'vl', int(bad[0]))}: the store is "
                f"damaged. {mend(store.path)}"
            )
    return broken


def _finite(values: NDArray[Any]) -> NDArray[np.bool_]:
    """As `np.isfinite`, also of bfloat16, which a store holds as bits."""
    if values.dtype == np.uint16:
        return (values & _BFLOAT16_EXPONENT) != _BFLOAT16_EXPONENT
    return np.isfinite(values)
