"""Each issue is found where it is put, and none where there is none."""

import pickle
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.base.errors import Issue
from pipeline.look.recording.episode import LoadedRecording

Find = Callable[..., tuple[Issue, ...]]
Copied = Callable[[str], Path]


def frames(folder: Path, view: str) -> list[Path]:
    return sorted((folder / view).rglob("*.jpg"))


def time_of(path: Path) -> float:
    return float(path.stem.rsplit("_", 1)[-1])


def test_little_is_found_in_real_recordings(shared_data: Path, issues_of: Find) -> None:
    expected = {
        "raw": [("flat channel", "state")],
        "new": [("flat channel", "state")],
        "old": [("flat channel", "action")],
    }
    for format, issues in expected.items():
        found = issues_of(shared_data / "insertion" / format)
        assert [(issue.kind, issue.stream) for issue in found] == issues


class TestCameras:
    def test_dead_for_a_while(self, copied: Copied, issues_of: Find) -> None:
        folder = copied("raw")
        paths = frames(folder, "View2")
        for path in paths[20:50]:
            Image.new("RGB", (224, 126), (90, 90, 90)).save(path)
        (issue,) = issues_of(folder, vlm_reuse_count=1)
        assert (issue.kind, issue.stream) == ("dead camera", "view View2")
        assert (issue.start_s, issue.stop_s) == (time_of(paths[20]), time_of(paths[49]))

    def test_frozen_while_the_others_move(self, copied: Copied, issues_of: Find) -> None:
        folder = copied("raw")
        frozen = frames(folder, "View1")[3:45]
        for path in frozen[1:]:
            path.write_bytes(frozen[0].read_bytes())
        (issue,) = issues_of(folder)
        assert (issue.kind, issue.stream) == ("duplicate frames", "view View1")
        assert issue.start_s == pytest.approx(time_of(frozen[0]))
        assert issue.stop_s is not None and issue.stop_s >= time_of(frozen[-1])
        assert "other views move" in issue.message

    def test_a_slower_camera_has_fewer_frames(self, copied: Copied, issues_of: Find) -> None:
        folder = copied("raw")
        for path in frames(folder, "View2")[1::2]:
            path.unlink()
        assert issues_of(folder) == ()

    def test_no_camera_at_all(self, copied: Copied, issues_of: Find) -> None:
        folder = copied("raw")
        assert any(issue.kind == "missing" for issue in issues_of(folder, views=[]))
        for view in ("View1", "View2", "View5"):
            shutil.rmtree(folder / view)
        (issue,) = issues_of(folder)
        assert (issue.kind, issue.stream) == ("missing", "cameras")
        assert issue.message == "no camera has a frame: the VLM would see no picture"


class TestChannels:
    def test_an_action_outlier(self, copied: Copied, issues_of: Find) -> None:
        folder = copied("old")
        path = folder / "data.pkl"
        document = pickle.loads(path.read_bytes())
        document["action"][20, 4] = 360.0
        path.write_bytes(pickle.dumps(document))
        # The recorded actions are looked at where no poses give others.
        (folder / "robot_states.npz").unlink()
        (issue,) = [issue for issue in issues_of(folder) if issue.kind != "missing"]
        assert (issue.kind, issue.stream) == ("action outlier", "action")
        assert "db leaps to 360 deg" in issue.message

    @pytest.mark.parametrize("row", [0, 300, -1])
    def test_a_state_outlier(self, copied: Copied, issues_of: Find, change_csv, row: int) -> None:
        folder = copied("raw")

        def leap(table: np.ndarray) -> np.ndarray:
            table[row, 6] = 360
            return table

        (path,) = folder.glob("robot_state_*.csv")
        change_csv(path, leap)
        time = np.loadtxt(path, delimiter=",", skiprows=1)[:, 1]
        (issue,) = issues_of(folder)
        assert (issue.kind, issue.stream) == ("state outlier", "state")
        assert issue.start_s == pytest.approx(time[row])
        assert "joint_3 leaps to 360 deg (row " in issue.message and "1 such rows" in issue.message


def test_a_recording_may_be_very_short(
    copied: Copied, look: Callable[..., LoadedRecording], issues_of
):
    folder = copied("raw")
    for view in ("View1", "View2", "View5"):
        for path in frames(folder, view)[1:]:
            path.unlink()
    view = look(folder)
    assert view.timeline is None or len(view.timeline.time) <= 1
    found = issues_of(folder)
    assert all(issue.kind in ("no ticks",) for issue in found) and found
