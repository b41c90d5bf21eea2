"""A robot's recording through a kill and a full disk: what was recorded until then is not lost."""

import itertools
import shutil
import signal
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.base.config import Source
from pipeline.base.errors import DiskFull, RecordingError
from pipeline.data import Recording, open_recordings
from pipeline.robot.recorder import RunRecorder, recover

CHANNELS = {"names": ["a", "b"], "units": ["", "mm"]}
METADATA = {
    "streams": {
        "action": CHANNELS | {"kind": "absolute"},
        "state": CHANNELS,
        "views": ["top"],
    },
    "action_hz": 10.0,
    "feature_spec_digest": "d",
}


def image_of(tick: int) -> np.ndarray:
    return np.random.default_rng(tick).integers(0, 256, (120, 160, 3), np.uint8)


def record(recorder: RunRecorder, tick: int) -> None:
    """One tick of ten states; an image every third."""
    if tick % 3 == 0:
        recorder.frames({"top": (tick / 10, image_of(tick))})
    observed: dict[str, Any] = {
        "time": np.array([tick / 10]),
        "state": np.full((10, 2), tick),
        "state_time": tick / 10 + np.arange(-9, 1) / 100,
    }
    recorder.tick(observed, np.array([tick, -tick]))


def run_on(folder: Path, told: Connection) -> None:
    """Record for ever, and tell of each tick."""
    recorder = RunRecorder(folder, METADATA, "Push")
    for tick in itertools.count():
        record(recorder, tick)
        told.send(tick)


def opened(folder: Path) -> Recording:
    (recording,) = open_recordings([Source(name="runs", path=str(folder))], folder).recordings
    return recording


def check_prefix(recording: Recording) -> int:
    """That a recording is the run so far; of how many ticks."""
    action, state = recording.action(), recording.state()
    assert action is not None and state is not None
    rows = len(action.time)
    np.testing.assert_array_equal(action.values[:, 0], np.arange(rows))
    np.testing.assert_allclose(action.time, np.arange(rows) / 10, atol=1e-9)
    whole = state.values[: 10 * rows, 0]
    np.testing.assert_array_equal(whole, np.repeat(np.arange(rows), 10))
    camera = recording.cameras()["top"]
    frames = np.arange(0, rows, 3)
    np.testing.assert_allclose(camera.time, frames / 10, atol=1e-9)
    for tick, frame in zip(frames, camera.read(range(len(frames))), strict=True):
        np.testing.assert_array_equal(frame, image_of(int(tick)))
    return rows


def test_a_killed_run(fork, tmp_path: Path) -> None:
    process, heard = fork(run_on, tmp_path)
    for _ in range(77):
        heard.recv()
    while not any(log.stat().st_size for log in tmp_path.glob("*/tick.bin")):
        heard.recv()  # where the machine is busy, the thread that writes comes late
    process.kill()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    (part,) = tmp_path.iterdir()
    assert part.name == "run_000000.part"
    with pytest.raises(RecordingError, match="none with an episode in it"):
        opened(tmp_path)
    path = recover(part)
    assert list(tmp_path.iterdir()) == [path]
    assert check_prefix(opened(path)) > 0


def test_a_recovery_that_is_killed_begins_anew(tmp_path: Path) -> None:
    recorder = RunRecorder(tmp_path, METADATA, "Push")
    for tick in range(7):
        record(recorder, tick)
    recorder._queue.put(None)
    recorder._thread.join()
    begun = recorder.part / ".recording" / "meta"
    begun.mkdir(parents=True)
    (begun / "info.json").write_text("{}")
    shutil.copy(recorder.part / "run.json", begun.parent)
    with pytest.raises(RecordingError, match="none with an episode in it"):
        opened(tmp_path)
    with (recorder.part / "tick.bin").open("ab") as log:
        log.write(b"cut off")
    assert check_prefix(opened(recover(recorder.part))) == 7


def test_a_full_disk_while_the_robot_moves(small_disk: Path) -> None:
    recorder = RunRecorder(small_disk, METADATA, "Push")
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(5 * 2**20))
    ticks = 0
    while recorder.failed is None and ticks < 20_000:
        record(recorder, ticks)
        ticks += 1
    record(recorder, ticks)
    assert recorder.failed is not None and "No space left" in recorder.failed
    with pytest.raises(DiskFull, match=r"run_000000\.part: the recording of this run is not fin"):
        recorder.finish("done")
    with pytest.raises(RecordingError, match="none with an episode in it"):
        opened(small_disk)
    ballast.unlink()
    assert 0 < check_prefix(opened(recover(recorder.part))) <= ticks
