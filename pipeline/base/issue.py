"""Something that looks wrong, and where: what every check of the project gives."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Severity = Literal["error", "warning", "note", "ok"]
"""An error keeps a stage from using what has it; a note could be better; `ok` was looked at."""


@dataclass(frozen=True, kw_only=True)
class Issue:
    """One thing that was looked at and how it is; times are float64 seconds on the clock of what
    was looked at."""

    severity: Severity
    kind: str
    """As docs/looking.md explains it: `gap`, `dead camera`, …"""
    message: str
    """One line: what was expected, and what is there."""
    source: str = ""
    episode: str = ""
    stream: str = ""
    """`view View1`, `sensor`, `state`, …, or an array of a store; empty for all of it."""
    start_s: float | None = None
    """None where it is all of the stream."""
    stop_s: float | None = None
    file: Path | None = None
    chunk: int | None = None
    """Of the array, where only one chunk file has it."""
    remedy: str = ""
    """What to install, set or run."""
