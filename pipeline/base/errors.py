"""The errors that a user can fix, and the issues that a check finds.

A stage prints a `PipelineError` without a traceback and exits with 2. The message says the expected
and the actual value, the place, and what to run next. Each subclass is also the builtin error that
a caller would catch without knowing this package.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


class PipelineError(Exception):
    """Base of all errors that the user can fix."""


class ConfigError(PipelineError, ValueError):
    """A value of params.yaml or of `--set` is wrong."""


class ObservationError(PipelineError, ValueError):
    """An observation does not fit the policy."""


class RecordingError(PipelineError, ValueError):
    """A recording on disk is missing something or contradicts itself."""


class VLMError(PipelineError, ValueError):
    """A vision-language checkpoint or adapter cannot be used as it is."""


class StoreMismatch(PipelineError, ValueError):
    """A store does not hold what a command needs."""


class StoreIncomplete(PipelineError, RuntimeError):
    """A store is missing, unfinished or damaged."""


class StoreLocked(PipelineError, RuntimeError):
    """Another process is building this store."""


class DiskFull(PipelineError, OSError):
    """The disk has too little space."""


class TooManyMaps(PipelineError, OSError):
    """The kernel refuses to map more files into this process."""


class NumericsError(PipelineError, ArithmeticError):
    """A NaN or an infinity where a finite number is needed."""


class CheckpointMismatch(PipelineError, ValueError):
    """A policy checkpoint does not fit the store, the params or the model it is used with."""


class CheckpointIncomplete(PipelineError, RuntimeError):
    """A policy checkpoint is missing, unfinished or damaged."""


class WireError(PipelineError, ValueError):
    """A message between robot and server is malformed."""


class ServerError(PipelineError, ConnectionError):
    """A policy server cannot be reached, refuses the connection, or is gone."""


class HubError(PipelineError, ConnectionError):
    """The Hugging Face Hub cannot be reached, or refuses a request."""


class RobotStopped(PipelineError, RuntimeError):
    """A run on a robot ended in a safe stop."""


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
    remedy: str = ""
    """What to install, set or run."""
