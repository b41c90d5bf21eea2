"""How well a store was compressed, as a table."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.store.archive.manifest import ArchivedArray

_SMALL = 0.01
"""Share of the bytes up to which an array has no line: of a tiny one, padding makes the ratio."""


@dataclass(frozen=True)
class ArchiveReport:
    """What an archive holds and how small it is."""

    output: Path
    arrays: Mapping[str, ArchivedArray]
    seconds: float | None
    """None where the archive was there already."""

    @property
    def raw_bytes(self) -> int:
        """Of the rows of all arrays."""
        return sum(array.raw_bytes for array in self.arrays.values())

    @property
    def stored_bytes(self) -> int:
        """Of all shards."""
        return sum(array.stored_bytes for array in self.arrays.values())

    def lines(self) -> list[str]:
        """A line a large array: its size, its codec, its ratio, what the candidates promised."""
        lines = [f"{'array':<20}{'MB':>10}{'ratio':>9}  {'codec':<22}on samples"]
        large = {
            name: array
            for name, array in self.arrays.items()
            if array.raw_bytes > _SMALL * self.raw_bytes
        }
        for name, array in large.items():
            size = f"{name:<20}{array.raw_bytes / 1e6:>10.3f}"
            ratio = _ratio(array.raw_bytes, array.stored_bytes)
            lines.append(f"{size}{ratio:>9}  {array.codec:<22}{_promised(array)}".rstrip())
        if small := len(self.arrays) - len(large):
            lines.append(f"and {small} small arrays")
        ratio = _ratio(self.raw_bytes, self.stored_bytes)
        return [*lines, f"{'all':<20}{self.raw_bytes / 1e6:>10.3f}{ratio:>9}"]


def _ratio(raw: int, stored: int) -> str:
    """Raw / stored; an array without data, or of nothing but zeros, takes no shard."""
    return f"{raw / stored:.2f}" if stored else "-"


def _promised(array: ArchivedArray) -> str:
    """The candidates by ratio, best first; those that lost a bit are named last."""
    exact = {name: ratio for name, ratio in array.ratios.items() if ratio is not None}
    ranked = sorted(exact, key=lambda name: -exact[name])
    said = [f"{name} {exact[name]:.2f}" for name in ranked]
    return ", ".join([*said, *(f"{name} inexact" for name in array.ratios if name not in exact)])
