"""What each array of a store takes on the disk."""

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

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


def array_sizes(path: Path) -> tuple[ArraySize, ...]:
    """Every array, the largest on the disk first; together they are all files below `path`."""
    specs = read_specs(path)
    disk: dict[str, int] = defaultdict(int)
    for file in path.rglob("*"):
        if file.is_file():
            disk[_owner(file.relative_to(path))] += file.stat().st_blocks * 512
    found = [
        ArraySize(
            name,
            spec.shape,
            spec.attributes.get("dtype", spec.dtype.name),
            spec.chunk_count,
            disk[name],
        )
        for name, spec in specs.items()
    ]
    found.append(ArraySize(METADATA, (), "", 0, disk[METADATA]))
    return tuple(sorted(found, key=lambda one: one.disk_bytes, reverse=True))


def _owner(inside: Path) -> str:
    """The array that a file is a chunk of: its first two folders; metadata are not chunks."""
    return METADATA if inside.name == "zarr.json" else "/".join(inside.parts[:2])
