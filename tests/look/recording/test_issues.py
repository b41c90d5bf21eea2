"""Each issue is found where it is put, and none where there is none."""

import json
import pickle
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.base.config import DataParams, Source
from pipeline.base.errors import Issue
from pipeline.data import open_recordings
from pipeline.look.recording.clocks import find_clock_issues
from pipeline.look.recording.episode import LoadedRecording, view_episode
from pipeline.look.recording.streams import find_channel_issues

Find = Callable[..., tuple[Issue, ...]]
Copied = Callable[[str], Path]
CR5 = "lerobot/cr5_banana_v21"


def only(folder: Path, pattern: str) -> Path:
    (path,) = folder.glob(pattern)
    return path


def frames(folder: Path, view: str) -> list[Path]:
    return sorted((folder / view).rglob("*.jpg"))


def time_of(path: Path) -> float:
    return float(path.stem.rsplit("_", 1)[-1])


def test_a_real_camera_that_loses_frames(shared_data: Path) -> None:
    path = shared_data / CR5
    data = DataParams(sources=(Source(name="s", path=str(path)),))
    recordings = open_recordings(data.sources).recordings
    found = {
        one.id: issue.message
        for one in recordings
        for issue in find_clock_issues(view_episode(one, data, "rotvec"))
        if issue.kind == "dropped frames"
    }
    assert found == {
        "episode_000000": "13 of 175 steps take at least 1.5 times the usual 99 ms (up to 233 ms): "
        "there is time for 18 more frames; 9.2 Hz on average"
    }


@pytest.mark.parametrize("format", ["raw", "new", "old", "lerobot"])
def test_nothing_is_found_in_a_healthy_recording(healthy: Path, issues_of: Find, format: str):
    assert issues_of(healthy / format) == ()


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

    def test_one_picture_throughout(self, copied: Copied, issues_of: Find) -> None:
        folder = copied("raw")
        paths = frames(folder, "View5")
        for path in paths[1:]:
            path.write_bytes(paths[0].read_bytes())
        (issue,) = issues_of(folder, views=["View5"])
        assert f"all {len(paths)} frames looked at are one picture" in issue.message

    def test_a_slower_camera_has_fewer_frames(self, copied: Copied, issues_of: Find) -> None:
        folder = copied("raw")
        for path in frames(folder, "View2")[1::2]:
            path.unlink()
        assert issues_of(folder) == ()

    def test_a_view_that_the_metadata_lists(self, copied: Copied, issues_of: Find) -> None:
        folder = copied("new")
        metadata(folder, camera_views=["View1", "View2", "View5", "View9"])
        assert any("camera_views has View9" in issue.message for issue in issues_of(folder))
        # A view that the params leave out is not missing.
        metadata(folder, camera_views=["View1", "View2", "View5"])
        assert issues_of(folder, views=["View1"]) == ()

    def test_no_camera_at_all(self, copied: Copied, issues_of: Find) -> None:
        folder = copied("raw")
        assert any(issue.kind == "missing" for issue in issues_of(folder, views=[]))
        for view in ("View1", "View2", "View5"):
            shutil.rmtree(folder / view)
        (issue,) = issues_of(folder)
        assert (issue.kind, issue.stream) == ("missing", "cameras")
        assert issue.message == "no camera has a frame: the VLM would see no picture"

    def test_a_promised_stream_that_is_broken_is_told_once(self, copied, issues_of):
        folder = copied("new")
        (folder / "sensor_data.npz").write_bytes(b"")
        assert [issue.kind for issue in issues_of(folder)] == ["unreadable"]

    def test_frames_lost_one_by_one(self, copied: Copied, issues_of: Find) -> None:
        folder = copied("raw")
        paths = frames(folder, "View2")
        lost = paths[5:-5:9]
        for path in lost:
            path.unlink()
        (issue,) = [issue for issue in issues_of(folder) if issue.kind == "dropped frames"]
        assert (issue.stream, issue.severity) == ("view View2", "warning")
        # The last of them may leave no time that is long enough.
        assert re.search(rf"time for ({len(lost)}|{len(lost) - 1}) more frames", issue.message)
        assert " Hz on average" in issue.message


class TestClocks:
    def test_a_gap(self, copied: Copied, issues_of: Find, change_csv) -> None:
        folder = copied("raw")
        path = only(folder, "robot_state_*.csv")
        time = np.loadtxt(path, delimiter=",", skiprows=1)[:, 1]
        change_csv(path, lambda table: np.delete(table, np.s_[200:300], axis=0))
        issue = next(issue for issue in issues_of(folder) if issue.kind == "gap")
        assert issue.stream == "state, poses"
        assert issue.start_s == pytest.approx(time[199]) and issue.stop_s == pytest.approx(
            time[300]
        )
        assert f"no entry for {time[300] - time[199]:.2f} s" in issue.message

    def test_another_rate_than_fps(self, copied: Copied, issues_of: Find) -> None:
        root = copied("lerobot")
        info = json.loads((root / "meta/info.json").read_text())
        (root / "meta/info.json").write_text(json.dumps(info | {"fps": 15}))
        issues = issues_of(root, action_hz=None)
        assert any("say 15 Hz (LeRobot: fps in meta/info.json)" in one.message for one in issues)


class TestChannels:
    def test_a_joint_that_hardly_moves(self, copied: Copied, issues_of: Find, change_csv) -> None:
        folder = copied("raw")
        rng = np.random.default_rng(0)

        def hold(noise: float) -> Callable[[np.ndarray], np.ndarray]:
            def change(table: np.ndarray) -> np.ndarray:
                table[:, 6] = 12.5 + noise * rng.normal(size=len(table))
                return table

            return change

        path = only(folder, "robot_state_*.csv")
        usual = np.median(np.loadtxt(path, delimiter=",", skiprows=1)[:, 4:10].std(axis=0))
        change_csv(path, hold(0.1 * usual))
        assert issues_of(folder) == ()
        change_csv(path, hold(0.002 * usual))
        (issue,) = issues_of(folder)
        assert (issue.kind, issue.stream, issue.severity) == ("still channel", "state", "warning")
        assert issue.message.startswith("joint_3 hardly moves: a standard deviation of ")

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

        path = only(folder, "robot_state_*.csv")
        change_csv(path, leap)
        time = np.loadtxt(path, delimiter=",", skiprows=1)[:, 1]
        (issue,) = issues_of(folder)
        assert (issue.kind, issue.stream) == ("state outlier", "state")
        assert issue.start_s == pytest.approx(time[row])
        assert "joint_3 leaps to 360 deg (row " in issue.message and "1 such rows" in issue.message

    def test_a_real_robot_that_leaps_and_stands_still(self, shared_data: Path) -> None:
        data = DataParams(sources=(Source(name="s", path=str(shared_data / CR5)),))
        found = {
            (one.id, issue.kind, issue.stream): issue.message
            for one in open_recordings(data.sources).recordings
            for issue in find_channel_issues(view_episode(one, data, "rotvec"))
        }
        ids = [f"episode_{place:06d}" for place in range(5)]
        assert [key[0] for key in found if key[1:] == ("state outlier", "state")] == ids[:1]
        assert "joint_5 leaps to 0.3222" in found[ids[0], "state outlier", "state"]
        assert [key[0] for key in found if key[1:] == ("still channel", "action")] == ids


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


def metadata(folder: Path, **changes: object) -> None:
    path = folder / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
