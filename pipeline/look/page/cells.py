"""Values -> the words of a table: as many digits as they deserve, numbers apart from text."""

import math
import numbers
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup, escape

NOTHING = "–"
"""What stands where there is no value."""
DIGITS = 4
"""Significant digits of a number that is no count."""
PLAIN = (1e-4, 1e7)
"""Magnitudes outside these are written with an exponent."""


@dataclass(frozen=True)
class Column:
    """A column as words; `numeric` ones stand right."""

    head: str
    numeric: bool
    cells: tuple[str, ...]


def columns_of(heads: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[Column]:
    """The columns of a table as words.

    Raises `ValueError` for a row of another length than the heads.
    """
    for index, row in enumerate(rows):
        if len(row) != len(heads):
            raise ValueError(f"row {index}: {len(row)} cells under {len(heads)} heads")
    return [_column(head, [row[index] for row in rows]) for index, head in enumerate(heads)]


def number(value: float) -> str:
    """A number in four significant digits, thousands apart; NaN is an en dash."""
    value = float(value)
    if math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    size = abs(value)
    if size == 0:
        return "0"
    if not PLAIN[0] <= size < PLAIN[1]:
        return f"{value:.{DIGITS - 1}e}"
    # Of the rounded number: 9.9999 has one digit more before the point than it seems.
    magnitude = int(f"{size:.{DIGITS - 1}e}".partition("e")[2])
    decimals = max(0, DIGITS - 1 - magnitude)
    return f"{value:,.{decimals}f}"


def sentence(words: str) -> str:
    """Words of a table or a terminal with a capital and a full stop, to stand in a text."""
    return f"{words[0].upper()}{words[1:]}."


def prose(words: str) -> Markup:
    """Plain words with what stands in backticks as code."""
    parts = re.split(r"`([^`]+)`", words)
    return Markup("").join(
        Markup("<code>{}</code>").format(part) if index % 2 else escape(part)
        for index, part in enumerate(parts)
    )


def breakable(words: str) -> Markup:
    """Words, a path or an id, that may go on in a new line after a `/` or `_` inside it."""
    return Markup(re.sub(r"(?<=\w)([/_])", r"\1<wbr>", str(escape(words))))


def _column(head: str, values: Sequence[Any]) -> Column:
    numeric = any(_is_number(value) for value in values) and all(
        value is None or _is_number(value) for value in values
    )
    if numeric and all(_is_whole(value) for value in values):
        cells = tuple(NOTHING if _is_missing(value) else f"{int(value):,}" for value in values)
    else:
        cells = tuple(_word(value) for value in values)
    return Column(head, numeric, cells)


def _word(value: Any) -> str:
    if value is None:
        return NOTHING
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, numbers.Integral):
        return f"{int(value):,}"
    if isinstance(value, numbers.Real):
        return number(float(value))
    return str(value)


def _is_number(value: Any) -> bool:
    return not isinstance(value, bool) and isinstance(value, numbers.Real)


def _is_missing(value: Any) -> bool:
    return value is None or math.isnan(value)


def _is_whole(value: Any) -> bool:
    return _is_missing(value) or (math.isfinite(value) and float(value).is_integer())
