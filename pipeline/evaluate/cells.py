"""Numbers and lines as tables show them."""

import csv
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from pipeline.base.durable import disk_full_named, fresh


def aligned(lines: Sequence[Sequence[str]], left: int = 1) -> list[str]:
    """Rows of cells as lines of equal length; the first `left` columns begin at their left."""
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    return [
        "  ".join(
            cell.ljust(width) if column < left else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        for line in lines
    ]


def cell(value: float) -> str:
    """A number for a CSV file, 6 significant digits; empty for NaN."""
    return "" if math.isnan(value) else f"{float(value):.6g}"


def numbers(values: dict[str, float | None] | dict[str, float]) -> dict[str, float]:
    """For a JSON document, 6 significant digits, without what has no value; it refuses a NaN."""
    return {key: float(f"{value:.6g}") for key, value in values.items() if value is not None}


def ratio(value: float | None) -> str:
    """A quotient for a printed table; a dash where it has none."""
    return "-" if value is None else f"{value:.2f}"


def write_rows(path: Path, rows: Iterable[Sequence[object]]) -> Path:
    """Write a CSV file and return its path. Raises `DiskFull`."""
    with disk_full_named(path.parent), fresh(path).open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)
    return path
