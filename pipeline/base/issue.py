"""The result of a check: something that looks wrong, and where."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Severity = Literal["error", "warning", "note", "ok"]
"""error: a stage cannot use it. note: it could be better. ok: it was checked."""


@dataclass(frozen=True, kw_only=True)
class Issue:
    """One checked thing and its state; times are float64 seconds on its own clock."""

    severity: Severity
    kind: str
    """As docs/looking.md explains it: `gap`, `dead camera`, …"""
    message: str
    """One line with the expected and the actual value."""
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
