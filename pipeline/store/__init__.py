"""The seam between the stages: a zarr store that is also a set of flat files.

`schema` says what is in it, `writer` builds it so that a kill loses nothing, `donor` takes rows
over from an older one, `reader` maps a finished one and gathers batches from it.
"""

from pipeline.store.batch import Batch
from pipeline.store.chunks import check_trailers
from pipeline.store.donor import Donor
from pipeline.store.lock import build_lock
from pipeline.store.names import episode_name, place
from pipeline.store.places import part_path, read_plan, recover
from pipeline.store.reader import Episode, FeatureStore
from pipeline.store.schema import FEATURES, KEY_BYTES, SCHEMA, Sizes, arrays
from pipeline.store.writer import StoreBuild

__all__ = [
    "FEATURES",
    "KEY_BYTES",
    "SCHEMA",
    "Batch",
    "Donor",
    "Episode",
    "FeatureStore",
    "Sizes",
    "StoreBuild",
    "arrays",
    "build_lock",
    "check_trailers",
    "episode_name",
    "part_path",
    "place",
    "read_plan",
    "recover",
]
