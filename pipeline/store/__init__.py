"""The store between the two stages: a zarr store that is also a set of flat files.

`schema` defines what is in it, `writer` builds it so that a kill loses little, `row_source` takes
rows from an older store, `reader` maps a finished store and gathers batches from it.

`Batch` is imported from `gather` on first use, because it imports torch, which is not needed to
write, open or check a store.
"""

from typing import TYPE_CHECKING, Any

from pipeline.store.chunks import check_trailers
from pipeline.store.episodes import Episode
from pipeline.store.golden_rows import GoldenFrames
from pipeline.store.known_rows import RowSource
from pipeline.store.lock import build_lock
from pipeline.store.paths import part_path, read_plan, recover
from pipeline.store.reader import FeatureStore, episode_name, place
from pipeline.store.schema import FEATURES, KEY_BYTES, SCHEMA, Sizes, arrays
from pipeline.store.writer import StoreBuild

if TYPE_CHECKING:
    from pipeline.store.gather import Batch

__all__ = [
    "FEATURES",
    "KEY_BYTES",
    "SCHEMA",
    "Batch",
    "Episode",
    "FeatureStore",
    "GoldenFrames",
    "RowSource",
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


def __getattr__(name: str) -> Any:
    if name == "Batch":
        from pipeline.store.gather import Batch

        return Batch
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
