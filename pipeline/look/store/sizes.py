"""What each array of a store takes on the disk."""

from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

from pipeline.base.table import Table
from pipeline.store.schema import read_specs

METADATA = "metadata"


def read_sizes(path: Path) -> dict[str, int]:
    """Bytes of the blocks that the files of each array take: values, padding and trailers.

    The largest first; `metadata` are all files that are no chunk. Together they are all files below
    `path`.
    """
    sizes: dict[str, int] = defaultdict(int)
    for file in path.rglob("*"):
        if file.is_file():
            # The first two folders of a chunk's path name its array.
            owner = "/".join(file.relative_to(path).parts[:2])
            sizes[METADATA if file.name == "zarr.json" else owner] += file.stat().st_blocks * 512
    return dict(sorted(sizes.items(), key=lambda item: -item[1]))


def tabulate_sizes(path: Path, sizes: Mapping[str, int]) -> Table:
    """A row an array of the store at `path`."""
    specs, total = read_specs(path), sum(sizes.values())
    rows: list[tuple[object, ...]] = []
    for name, taken in sizes.items():
        shape, dtype, chunks = "", "", 0
        if name in specs:
            spec = specs[name]
            shape = " × ".join(f"{count:,}" for count in spec.shape)
            dtype, chunks = spec.attributes.get("dtype", spec.dtype.name), spec.chunk_count
        rows.append((name, shape, dtype, chunks, taken / 2**20, 100 * taken / total))
    heads = ("array", "shape", "dtype", "chunks", "on the disk [MiB]", "share [%]")
    return Table(heads, rows, "Bytes on the disk by array.")
