"""What cannot be read is an issue; everything else is there all the same."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.base.errors import RecordingError
from pipeline.look.recording.cameras import read_frames, spread_ticks
from pipeline.look.recording.clocks import read_clocks
from pipeline.look.recording.episode import LoadedRecording
from pipeline.look.recording.page import find_issues

Look = Callable[..., LoadedRecording]


def only(folder: Path, pattern: str) -> Path:
    (path,) = folder.glob(pattern)
    return path


def test_a_nan_leaves_the_other_streams(copied, look: Look, change_npz) -> None:
    folder = copied("raw")

    def spoil(force: np.ndarray) -> np.ndarray:
        force[7] = np.nan
        return force

    change_npz(only(folder, "sensor_data_*.npz"), forces=spoil)
    view = look(folder)
    (issue,) = view.issues
    assert (issue.kind, issue.severity, issue.stream) == ("unreadable", "error", "sensor")
    assert "nan in row 7, 0.01" in issue.message and "channel 'force'" in issue.message
    assert view.sensor is None and view.state is not None and len(view.cameras) == 3
    assert view.timeline is not None and not view.timeline.sensor_end.any()
    assert find_issues(view)[0] == issue
    assert view.shown.keys() == {"state", "action"}


def test_a_backwards_clock_leaves_the_other_streams(copied, look: Look, change_csv) -> None:
    folder = copied("raw")

    def turn_back(table: np.ndarray) -> np.ndarray:
        table[100, 1] = table[90, 1]
        return table

    change_csv(only(folder, "robot_state_*.csv"), turn_back)
    view = look(folder)
    (issue,) = view.issues
    assert issue.stream == "state" and "the clock goes backwards at row 100" in issue.message
    # Without poses there are no actions, and so no ticks: told once, by the state's issue.
    assert view.state is None and view.poses is None and view.timeline is None
    assert view.sensor is not None and len(view.cameras) == 3
    assert find_issues(view) == (issue,)
    views = {"view View1", "view View2", "view View5"}
    assert {clock.name for clock in read_clocks(view)} == views | {"sensor"}
    assert spread_ticks(view, 5) == []


def test_a_truncated_file_is_told_once(copied, look: Look) -> None:
    folder = copied("old")
    pickled = folder / "data.pkl"
    pickled.write_bytes(pickled.read_bytes()[:500])
    view = look(folder)
    (issue,) = view.issues
    assert issue.severity == "error" and str(pickled) in issue.message
    assert {"cameras", "sensor", "action", "instruction"} <= set(issue.stream.split(", "))
    assert not view.clocks and view.zero == 0 and view.duration_s == 0
    assert view.instruction is None
    assert find_issues(view) == (issue,)
    assert read_clocks(view) == [] and view.shown == {}
    with pytest.raises(RecordingError):
        _ = view.recording.instruction


def test_streams_that_never_meet_leave_no_ticks(copied, look: Look, change_npz) -> None:
    folder = copied("raw")
    change_npz(only(folder, "sensor_data_*.npz"), timestamps=lambda time: time + 1000)
    view = look(folder)
    (issue,) = view.issues
    assert (issue.kind, issue.severity, issue.stream) == ("no ticks", "error", "ticks")
    assert "no instant is covered by every stream" in issue.message
    assert view.timeline is None and view.sensor is not None and view.state is not None


def test_a_view_that_cannot_be_decoded_is_left_out(copied, look: Look) -> None:
    folder = copied("raw")
    for path in (folder / "View2").iterdir():
        path.write_bytes(b"no picture")
    view = look(folder)
    assert set(read_frames(view, spread_ticks(view, 3))[0]) == {"View1", "View5"}
    (issue,) = find_issues(view)
    assert (issue.kind, issue.severity, issue.stream) == ("unreadable", "error", "view View2")
    assert "cannot be decoded" in issue.message
