"""What each array of a store takes on the disk."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.table import Table
from pipeline.store.schema import read_specs

METADATA = "metadata"


@dataclass(frozen=True)
class ArraySize:
    """One array and its files."""

    name: str
    """As in the store; `metadata` for every file that is no chunk."""
    shape: tuple[int, ...]
    dtype: str
    chunks: int
    """Chunk files."""
    disk_bytes: int
    """Blocks that its files take: values, padding of the last chunk, and trailers."""


def read_sizes(path: Path) -> tuple[ArraySize, ...]:
    """Every array, the largest on the disk first; together they are all files below `path`."""
    disk: dict[str, int] = defaultdict(int)
    for file in path.rglob("*"):
        if file.is_file():
            # The first two folders of a chunk's path name its array.
            owner = "/".join(file.relative_to(path).parts[:2])
            disk[METADATA if file.name == "zarr.json" else owner] += file.stat().st_blocks * 512
    sizes = [
        ArraySize(
            name,
            spec.shape,
            spec.attributes.get("dtype", spec.dtype.name),
            spec.chunk_count,
            disk[name],
        )
        for name, spec in read_specs(path).items()
    ]
    sizes.append(ArraySize(METADATA, (), "", 0, disk[METADATA]))
    return tuple(sorted(sizes, key=lambda array: array.disk_bytes, reverse=True))


def tabulate_sizes(sizes: Sequence[ArraySize]) -> Table:
    """A row an array."""
    total = max(1, sum(array.disk_bytes for array in sizes))
    rows = [
        (
            array.name,
            " × ".join(f"{count:,}" for count in array.shape),
            *(array.dtype, array.chunks, array.disk_bytes / 2**20, 100 * array.disk_bytes / total),
        )
        for array in sizes
    ]
    heads = ("array", "shape", "dtype", "chunks", "on the disk [MiB]", "share [%]")
    return Table(heads, rows, "Bytes on the disk by array.")
