"""Every format the demo writes reads back, and nothing that is not the demo's is touched."""

import errno
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pipeline.base.config import Source
from pipeline.base.errors import ConfigError, DiskFull
from pipeline.data import Recording, open_recordings
from pipeline.simulation import demo_recordings
from pipeline.simulation.demo_recordings import MARKER, write_demo_recordings
from pipeline.simulation.recorder import Demonstration
from pipeline.simulation.rendering import VIEWS, render

SETS = ("raw", "new", "old", "lerobot")
EPISODES, SEED = 3, 7


def recordings(root: Path, name: str) -> list[Recording]:
    """The episodes of a set; each must be there and whole."""
    opened = open_recordings([Source(name=name, path=name)], root)
    assert not opened.bad and not opened.missing
    return list(opened.recordings)


@cache
def simulated(name: str) -> list[Demonstration]:
    """The episodes that a set was written from."""
    seeds = np.random.SeedSequence
    found = []
    for index in range(EPISODES):
        own = int(seeds([SEED, SETS.index(name), index]).generate_state(1)[0])
        epoch = demo_recordings._FIRST_EPOCH_S + SETS.index(name) * 86_400.0 + index * 45.0
        epoch += np.random.default_rng(own).uniform(0, 1)
        found.append(demo_recordings.simulate_episode(own, epoch, index % 6 == 2))
    return found


def contents(root: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize("name", SETS)
def test_a_set_reads_back_as_what_was_simulated(demo_root, name: str) -> None:
    found = recordings(demo_root, name)
    assert len(found) == EPISODES
    for recording, truth in zip(found, simulated(name), strict=True):
        assert recording.format == name
        state, sensor = recording.state(), recording.sensor()
        # LeRobot counts from its first row, which is a tick after the beginning.
        origin = truth.epoch_s + 0.1 if name == "lerobot" else 0.0
        poses = truth.poses(state.time + origin)
        turned = (state.values[:, 9:] - poses[:, 3:] + 180) % 360 - 180
        assert np.abs(state.values[:, 6:9] - poses[:, :3]).max() < 0.02
        assert np.abs(turned).max() < 0.02
        before = np.searchsorted(truth.sensor_time, sensor.time + origin, side="right") - 1
        rows = np.maximum(before, 0)
        near = np.abs(truth.sensor[rows, 1:] - sensor.values[:, 1:]).max(axis=1)
        # A clock that is rebuilt may be a reading off where a scan gives way to the next.
        assert np.mean(near == 0) > 0.7
        assert len(sensor.values) > 0.97 * truth.duration_s * (10 if name == "old" else 650) - 1


@pytest.mark.parametrize("name", SETS)
def test_frames_show_the_scene_at_their_time(demo_root, name: str) -> None:
    recording, truth = recordings(demo_root, name)[0], simulated(name)[0]
    cameras = recording.cameras()
    assert tuple(cameras) == VIEWS
    origin = truth.epoch_s + 0.1 if name == "lerobot" else 0.0
    for view, camera in cameras.items():
        picked = [0, len(camera.time) // 3, len(camera.time) - 1]
        assert len(camera.time) >= 0.9 * 10 * truth.duration_s - 2
        for index, frame in zip(picked, camera.read(picked), strict=True):
            scene = truth.insertion.scene(camera.time[index] + origin - truth.epoch_s)
            # JPEG and H.264 keep it to a few levels on average; a wrong frame is far off.
            assert np.abs(frame.astype(int) - render(view, scene).astype(int)).mean() < 4


def test_all_formats_are_one_embodiment_whose_actions_lead_from_pose_to_pose(demo_root) -> None:
    channels = set()
    for name in SETS:
        for recording, truth in zip(recordings(demo_root, name), simulated(name), strict=True):
            state, sensor, action = recording.state(), recording.sensor(), recording.action()
            channels.add((state.channels, sensor.channels))
            if name in ("raw", "new"):
                assert action is None and recording.poses() is not None
            else:
                assert action is not None and action.kind == "delta"
                assert (action.values[:, 6] == 1).all()
                origin = truth.epoch_s + 0.1 if name == "lerobot" else 0.0
                steps = np.diff(truth.poses(action.time + origin), axis=0)
                steps = (steps + 180) % 360 - 180
                np.testing.assert_allclose(action.values[:-1, :6], steps, atol=2e-3)
    assert len(channels) == 1


def test_clocks_start_apart_and_jitter_and_one_episode_crosses_180(demo_root) -> None:
    recording = recordings(demo_root, "raw")[0]
    state, sensor = recording.state(), recording.sensor()
    clocks = [state.time, sensor.time, *(c.time for c in recording.cameras().values())]
    assert len({clock[0] for clock in clocks}) == len(clocks)
    for clock in clocks:
        assert np.diff(clock).std() > 1e-5
    assert np.diff(state.time).max() > 0.04
    for name in SETS:
        states = [recording.state() for recording in recordings(demo_root, name)]
        jumps = [s is not None and np.abs(np.diff(s.values[:, 11])).max() > 300 for s in states]
        assert jumps == [False, False, True]


def test_same_seed_same_bytes(demo_root, tmp_path) -> None:
    """An episode is the same whatever the number of episodes; only what counts them is not."""
    write_demo_recordings(tmp_path / "again", 1, SEED)
    again, before = contents(tmp_path / "again"), contents(demo_root)
    counting = [name for name in again if name == MARKER or "meta/" in name]
    assert counting and all(again[name] == before[name] for name in again.keys() - {*counting})


@pytest.fixture
def quick_sets(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Replaces the writers by ones that write a file; returns the names of the sets written."""
    written: list[str] = []

    def writer(name: str) -> demo_recordings.Write:
        def write(folder: Path, episodes: demo_recordings.Episodes) -> None:
            folder.mkdir()
            (folder / "content").write_text(name, encoding="utf-8")
            written.append(name)

        return write

    monkeypatch.setattr(demo_recordings, "_SETS", {name: writer(name) for name in SETS})
    return written


def test_a_finished_demo_is_kept_and_other_params_replace_it_unless_files_were_added(
    quick_sets, tmp_path
):
    root = tmp_path / "demo"
    for seed in (0, 0, 1):
        write_demo_recordings(root, 2, seed)
    assert sorted(quick_sets) == sorted([*SETS, *SETS])
    (root / "raw/mine").touch()  # an episode of the user's
    write_demo_recordings(root, 2, 1)
    with pytest.raises(ConfigError, match=f"{root}: expected the files that the demo wrote"):
        write_demo_recordings(root, 2, 2)
    assert (root / "raw/mine").exists() and (root / "new/content").exists()


def test_a_stopped_run_leaves_nothing_and_a_full_disk_says_so(quick_sets, tmp_path, monkeypatch):
    for error, raised in (
        (KeyboardInterrupt(), KeyboardInterrupt),
        (OSError(errno.ENOSPC, "No space left on device"), DiskFull),
    ):

        def stopped(folder: Path, episodes: object, error: BaseException = error) -> None:
            folder.mkdir()
            raise error

        monkeypatch.setitem(demo_recordings._SETS, "old", stopped)
        with pytest.raises(raised):
            write_demo_recordings(tmp_path / "demo", 2, 0)
        assert not [*tmp_path.iterdir()]


def test_a_folder_that_the_demo_did_not_write_is_left_alone(quick_sets, tmp_path) -> None:
    (tmp_path / "file").touch()
    for place in (tmp_path / "file", tmp_path):
        with pytest.raises(ConfigError, match="expected nothing there or a demo"):
            write_demo_recordings(place, 2, 0)
    (tmp_path / "file").rename(tmp_path / MARKER)
    with pytest.raises(ConfigError, match=rf"{MARKER}: .* Remove the folder"):
        write_demo_recordings(tmp_path, 2, 0)
