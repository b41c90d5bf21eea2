"""Of a recorded run on a robot: how it went, and whether a store has the features it acted on."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.base.differences import describe, differences
from pipeline.base.errors import RecordingError, StoreMismatch
from pipeline.data.arrays import member, read_json, read_npz
from pipeline.data.lerobot_writer import EPISODE
from pipeline.robot.run_recording import RUN
from pipeline.store import FeatureStore


@dataclass(frozen=True)
class KeyComparison:
    """The VL rows of a run in a store, and whether the robot's features had the same keys."""

    rows: int
    missing: NDArray[np.int64]
    """The run's VL rows, counted from 0, whose key no answer carried."""
    missing_s: NDArray[np.float64]
    """When they are, in s since the run's first row."""
    differs: tuple[str, ...]
    """The entries in which the feature specs of the policy and of the store differ."""

    def __str__(self) -> str:
        equal = f"{self.rows - len(self.missing)} of {self.rows} VL rows have a key of the robot's"
        if self.differs:
            return f"{equal}; the feature specs differ: {'; '.join(self.differs)}"
        pairs = zip(self.missing, self.missing_s, strict=True)
        at = [f"{row} ({time:.2f} s)" for row, time in pairs]
        return f"{equal}; not: {', '.join(at)}" if at else equal


def compare_keys(recording: str | Path, store: FeatureStore) -> KeyComparison:
    """Compare a recorded run with the store that was extracted from it.

    A key is a digest of feature spec, prompt and pixels: where the row's key is one that the robot
    acted on, the store has that very feature. A row's may be missing because the model was given
    those frames and had no time for them. Raises `StoreMismatch` where the store has not, or has
    more than once, an episode at the recording's path, `RecordingError` where it is no run.
    """
    root = Path(recording).resolve()
    path = root / "features" / f"{EPISODE}.npz"
    if not path.is_file():
        raise RecordingError(f"{root}: expected a recorded run, found no features/{path.name}")
    keys = member(read_npz(path, ("key",)), ("key",), path)
    episodes = [e for e in store.episodes if f"/{root}".endswith(f"/{e.path.lstrip('/')}")]
    if len(episodes) != 1:
        raise StoreMismatch(
            f"{store.path}: expected the one episode of {root}, found {len(episodes)} of "
            f"{len(store.episodes)} at such a path. Extract the recording: python -m stages.extract"
        )
    rows = slice(episodes[0].vl_rows.start, episodes[0].vl_rows.stop)
    known = {key.tobytes() for key in keys}
    stored = store.array("vl/key")[rows]
    missing = np.flatnonzero([key.tobytes() not in known for key in stored])
    trained = read_json(root / RUN)["metadata"]["feature_spec"]
    told = tuple(describe(differences(trained, store.spec)))
    return KeyComparison(len(stored), missing, store.array("vl/time")[rows][missing], told)


def describe_run(recording: Path) -> str | None:
    """What a recorded run says of itself, in a sentence; None for what is none."""
    if not (recording / RUN).is_file():
        return None
    run = read_json(recording / RUN)
    dropped = f", {count} images dropped" if (count := run.get("dropped_images")) else ""
    return (
        f"Recorded on a robot: {run['rows']} of {run['ticks']} ticks have an action{dropped}; it "
        f"ended: {run['reason']}."
    )
