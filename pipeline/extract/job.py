"""What the coordinator of a cluster tells its workers, and they tell it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import Params
from pipeline.data import Recording
from pipeline.vlm.feature_spec import FeatureSpec

Came = Literal["computed", "known", "repeated"]
"""Of a row: from the model, from a donor that knows its key, or from an equal row of its piece."""


@dataclass(frozen=True)
class Job:
    """What every worker of an extraction must know."""

    target: Path
    """Absolute."""
    plan: str
    spec: FeatureSpec
    params: Params
    donors: tuple[Path, ...]
    folder: Path
    """Where the coordinator runs: relative paths of recordings and checkpoint begin there."""
    local: bool
    """Whether the workers are the coordinator's own processes, on its host."""

    @property
    def name(self) -> str:
        """Of the plugin: an extraction that was killed is replaced by the next on its store."""
        return f"extraction of {self.target}"


@dataclass(frozen=True)
class Piece:
    """Missing rows of one episode, ascending, and the capture times (row, view) of their frames."""

    episode: int
    recording: Recording
    rows: NDArray[np.int64]
    frame_time: NDArray[np.float64]


@dataclass(frozen=True)
class WrittenRows:
    """Feature rows that lie in the build and only need marking."""

    rows: NDArray[np.int64]
    keys: Sequence[bytes]
    checksums: NDArray[np.uint32]
    environment: Mapping[str, Any]
    came: Came


@dataclass(frozen=True)
class Outcome:
    """What became of the pieces of a task."""

    written: tuple[WrittenRows, ...]
    failed: Mapping[int, str]
    """Why, by the piece's place in the task."""
