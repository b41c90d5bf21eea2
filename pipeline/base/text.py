"""Amounts, documents and tables as text."""

import csv
import io
import json
import math
import numbers
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from pipeline.base.files import disk_full_named, fresh

MOST_LINES = 20
"""Most lines of one kind that are shown; the rest is only counted."""


def size(count: float) -> str:
    """Bytes in the largest binary unit that fits at least once: `512 B`, `1.5 GiB`."""
    for unit, factor in (("TiB", 2**40), ("GiB", 2**30), ("MiB", 2**20)):
        if count >= factor:
            return f"{count / factor:.1f} {unit}"
    return f"{count / 2**10:.0f} KiB" if count >= 2**10 else f"{count:.0f} B"


def counted(count: int, noun: str) -> str:
    """`1 episode`, `1,200 episodes`."""
    return f"{count:,} {noun}" + "s" * (count != 1)


def duration(seconds: float) -> str:
    """Seconds to three digits; minutes from two minutes on, hours from two hours on."""
    if seconds < 120:
        return f"{seconds:.3g} s"
    minutes = seconds / 60
    return f"{minutes:.1f} min" if minutes < 120 else f"{minutes / 60:,.1f} h"


def capped(lines: Sequence[str], kind: str, most: int = MOST_LINES) -> list[str]:
    """The first lines, and one line with the number of the others if there are any."""
    more = len(lines) - most
    return [*lines[:most], *([f"and {more} more {kind}"] if more > 0 else [])]


def as_yaml(document: Mapping[str, Any]) -> str:
    """A nested document as YAML in its own order; flat lists and objects take one line."""
    plain = json.loads(json.dumps(document, default=str))
    return yaml.safe_dump(
        plain, sort_keys=False, default_flow_style=None, width=float("inf"), allow_unicode=True
    )


NOTHING = "–"
"""Stands for a missing value."""
DIGITS = 4
"""Significant digits of a number that is not a count."""
NOISE = 1e-9
"""A number below this is written as nearly 0."""
PLAIN = (1e-4, 1e7)
"""Magnitudes outside these are written with an exponent."""


@dataclass(frozen=True)
class Column:
    """A column as text; `numeric` ones are right-aligned."""

    head: str
    numeric: bool
    cells: tuple[str, ...]


@dataclass(frozen=True)
class Table:
    """Rows of cells under column heads; numbers are right-aligned, with four significant digits.

    A cell is a word, a number, a bool or None.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    caption: str = ""
    strong: frozenset[int] = field(default_factory=frozenset[int])
    """Rows that a page emphasises."""

    @classmethod
    def of(cls, rows: Iterable[Mapping[str, Any]]) -> "Table":
        """The table of one or more rows with the same heads."""
        rows = list(rows)
        return cls(list(rows[0]), [list(row.values()) for row in rows])

    def words(self) -> list[Column]:
        """The columns as text."""
        return [
            _column(head, [row[index] for row in self.rows])
            for index, head in enumerate(self.columns)
        ]

    def text(self) -> list[str]:
        """Aligned lines for a terminal, heads first."""
        columns = self.words()
        widths = [max(map(len, (column.head, *column.cells))) for column in columns]
        lines = zip(*((column.head, *column.cells) for column in columns), strict=True)
        return [
            "  ".join(
                cell.rjust(width) if column.numeric else cell.ljust(width)
                for cell, width, column in zip(line, widths, columns, strict=True)
            ).rstrip()
            for line in lines
        ]

    def markdown(self) -> list[str]:
        """Lines of a Markdown table."""
        columns = ((c.head, "---:" if c.numeric else "---", *c.cells) for c in self.words())
        return ["| " + " | ".join(line) + " |" for line in zip(*columns, strict=True)]

    def csv(self) -> str:
        """For programs: floats with 6 significant digits; empty where there is no value."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows([_plain(cell) for cell in row] for row in self.rows)
        return text.getvalue()

    def write_csv(self, path: Path) -> Path:
        """Write `csv()` and return the path. Raises `DiskFull`."""
        with (
            disk_full_named(path.parent),
            fresh(path).open("w", encoding="utf-8", newline="") as out,
        ):
            out.write(self.csv())
        return path


def number(value: float) -> str:
    """A number with four significant digits and thousands separators; NaN is an en dash.

    What is smaller than `NOISE` is the rounding of a computer, in every unit that is used here.
    """
    value = float(value)
    if math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    size = abs(value)
    if size == 0:
        return "0"
    if size < NOISE:
        return "≈ 0"
    if not PLAIN[0] <= size < PLAIN[1]:
        return f"{value:.{DIGITS - 1}e}"
    # Taken from the rounded number, because 9.9999 becomes 10.00.
    magnitude = int(f"{size:.{DIGITS - 1}e}".partition("e")[2])
    return f"{value:,.{max(0, DIGITS - 1 - magnitude)}f}"


def _column(head: str, values: Sequence[Any]) -> Column:
    present = [value for value in values if value is not None]
    numeric = bool(present) and all(
        isinstance(v, numbers.Real) and not _is_bool(v) for v in present
    )
    whole = numeric and all(math.isnan(value) or float(value).is_integer() for value in present)
    cells = [int(v) if whole and v is not None and not math.isnan(v) else v for v in values]
    return Column(head, numeric, tuple(map(_word, cells)))


def _word(value: Any) -> str:
    if value is None:
        return NOTHING
    if _is_bool(value):
        return "yes" if value else "no"
    if isinstance(value, numbers.Integral):
        return f"{int(value):,}"
    return number(float(value)) if isinstance(value, numbers.Real) else str(value)


def _plain(value: Any) -> Any:
    if isinstance(value, numbers.Real) and not isinstance(value, numbers.Integral):
        return "" if math.isnan(value) else f"{float(value):.6g}"
    return "" if value is None else value


def _is_bool(value: Any) -> bool:
    return type(value).__name__ in ("bool", "bool_")
