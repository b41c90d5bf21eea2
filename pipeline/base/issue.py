"""The result of a check: something that looks wrong, and where."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Severity = Literal["error", "warning", "note", "ok"]
"""error: a stage cannot use it. note: it could be better. ok: it was checked."""


@dataclass(frozen=True, kw_only=True)
class Issue:
    """One checked thing and its state; times are float64 seconds on the episode's own clock."""

    severity: Severity
    kind: str
    """As explained in docs/looking.md: `gap`, `dead camera`, …"""
    message: str
    """One line with the expected and the actual value."""
    source: str = ""
    episode: str = ""
    stream: str = ""
    """`view View1`, `sensor`, `state`, …, or an array of a store; empty where it concerns all."""
    start_s: float | None = None
    """None where it concerns the whole stream."""
    stop_s: float | None = None
    file: Path | None = None
    chunk: int | None = None
    """The chunk of the array, if it concerns only one chunk file."""
    remedy: str = ""
    """What to install, set or run."""
