"""Bytes, seconds and documents in readable form."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import yaml

MOST_LINES = 20
"""Most lines of one kind that are shown; the rest is only counted."""


def size(count: float) -> str:
    """Bytes in the largest binary unit that fits at least once: `512 B`, `1.5 GiB`."""
    for unit, factor in (("TiB", 2**40), ("GiB", 2**30), ("MiB", 2**20)):
        if count >= factor:
            return f"{count / factor:.1f} {unit}"
    return f"{count / 2**10:.0f} KiB" if count >= 2**10 else f"{count:.0f} B"


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
