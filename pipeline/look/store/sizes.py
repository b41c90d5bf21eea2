"""What each array of a store takes on the disk."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from pipeline.base.format import size
from pipeline.base.table import Table
from pipeline.look.page.blocks import Block, Picture
from pipeline.look.page.style import PALETTE, canvas
from pipeline.store.schema import read_specs

METADATA = "metadata"
_BARS = 8


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
    return tuple(sorted(sizes, key=lambda one: one.disk_bytes, reverse=True))


def size_blocks(sizes: Sequence[ArraySize]) -> list[Block]:
    """The picture, and a row an array."""
    total = sum(one.disk_bytes for one in sizes)
    rows = [
        (
            one.name,
            " × ".join(f"{count:,}" for count in one.shape),
            *(one.dtype, one.chunks, one.disk_bytes / 2**20, 100 * one.disk_bytes / max(1, total)),
        )
        for one in sizes
    ]
    return [
        Picture("sizes", "Bytes on the disk by array.", partial(draw_sizes, sizes)),
        Table(("array", "shape", "dtype", "chunks", "on the disk [MiB]", "share [%]"), rows),
    ]


def draw_sizes(sizes: Sequence[ArraySize]) -> Figure:
    """Bytes on the disk by array, the largest first, the small ones together."""
    shown = {one.name: one.disk_bytes for one in sizes[:_BARS]}
    if rest := sum(one.disk_bytes for one in sizes[_BARS:]):
        shown[f"{len(sizes) - _BARS} others"] = rest
    figure = canvas(8.5, 1.1 + 0.34 * len(shown))
    axis = figure.subplots()
    taken = np.array([*shown.values()])
    shares = taken / max(1, taken.sum())
    bars = axis.barh([*shown], taken / 2**20, 0.7, color=PALETTE[0])
    labels = [
        f"{size(count)}, {share:.1%}" if share >= 0.001 else size(count)
        for count, share in zip(taken, shares, strict=True)
    ]
    axis.bar_label(bars, labels, padding=5, size=9)
    axis.invert_yaxis()
    axis.set_xlim(0, max(taken.max() / 2**20 * 1.25, 1e-3))
    axis.set_xlabel("on the disk [MiB]")
    axis.grid(axis="y", visible=False)
    return figure
