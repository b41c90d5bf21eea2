"""A robot's recorded run compared with its store: does the store have the robot's features?"""

from pathlib import Path

import numpy as np

from pipeline.base.commands import command
from pipeline.base.differences import describe, differences
from pipeline.base.errors import RecordingError, StoreMismatch
from pipeline.data.arrays import member, read_npz
from pipeline.data.lerobot_meta import sidecar
from pipeline.data.recording import RECORDINGS
from pipeline.robot.recorder import RUN, RunDocument
from pipeline.store import FeatureStore


def compare_keys(recording: str | Path, store: FeatureStore) -> str:
    """How many VL rows of a run's store have a key that the robot used, and which have none.

    Rows without one are named by their number, from 0, and their time since the run's first row. If
    the feature specs of policy and store differ, the text names the differences instead.

    A key is a digest of feature spec, prompt and pixels: if the robot used the row's key, it acted
    on the same features that the store has. A key may be missing because the model had no time for
    those frames. Raises `StoreMismatch` unless the store has exactly one episode at the recording's
    path, and `RecordingError` if the recording is not a run.
    """
    root = Path(recording).resolve()
    path = sidecar(root, "features")
    if not path.is_file():
        raise RecordingError(f"{root}: expected a recorded run, found no features/{path.name}")
    keys = member(read_npz(path, ("key",)), ("key",), path)
    episodes = [e for e in store.episodes if f"/{root}".endswith(f"/{e.path.lstrip('/')}")]
    if len(episodes) != 1:
        raise StoreMismatch(
            f"{store.path}: expected the one episode of {root}, found {len(episodes)} of "
            f"{len(store.episodes)} at such a path. Extract the recording: {command('extract')}"
        )
    rows = slice(episodes[0].vl_rows.start, episodes[0].vl_rows.stop)
    known = {key.tobytes() for key in keys}
    stored = store.array("vl/key")[rows]
    missing = np.flatnonzero([key.tobytes() not in known for key in stored])
    equal = f"{len(stored) - len(missing)} of {len(stored)} VL rows have a key of the robot's"
    trained = RECORDINGS.read_json(root / RUN, RunDocument).metadata["feature_spec"]
    if differing := describe(differences(trained, store.spec)):
        return f"{equal}; the feature specs differ: {'; '.join(differing)}"
    times = store.array("vl/time")[rows][missing]
    at = [f"{row} ({time:.2f} s)" for row, time in zip(missing, times, strict=True)]
    return f"{equal}; not: {', '.join(at)}" if at else equal
