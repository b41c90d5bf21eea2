"""Frames of recordings are those of the store, or none."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.base.config import Source
from pipeline.base.digests import file_digest
from pipeline.data import Recording, content_digest, open_recordings
from pipeline.data.timeline import Timeline, build_timeline
from pipeline.evaluate.sources import (
    EpisodeFrames,
    read_episode_frames,
    shown_ticks,
)
from pipeline.simulation.insertion_formats import (
    ABUTTING,
    write_lerobot,
    write_new,
    write_old,
    write_raw,
)
from pipeline.simulation.recorder import simulate_episode
from pipeline.store import FeatureStore

FORMATS = ("raw", "new", "old", "lerobot")
REUSE = 3


class Stored:
    """What a store says of one recording, and the recording's own timeline beside it."""

    def __init__(self, recording: Recording, root: Path, views: Sequence[str]) -> None:
        self.recording = recording
        self.timeline: Timeline = build_timeline(recording, 10, REUSE, "rotvec")
        times = self.timeline.frame_times(views)
        self.store = SimpleNamespace(
            spec={"views": list(views)}, array={"vl/frame_time": times}.__getitem__
        )
        self.episode = SimpleNamespace(
            id=recording.id,
            path=recording.path.relative_to(root).as_posix(),
            format=recording.format,
            content=content_digest(recording, file_digest),
        )

    def frames(self, rows: Sequence[int], root: Path) -> EpisodeFrames:
        return read_episode_frames(self.store, self.episode, rows, root)  # type: ignore[arg-type]


@pytest.fixture(scope="session")
def recorded_demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("footage") / "recordings"
    first, second = (simulate_episode(seed, 1.767e9 + 100 * seed) for seed in (3, 4))
    write_raw(root / "raw" / "task", first)
    write_new(root / "new" / "task", first, ABUTTING, robot_clock=True)
    write_old(root / "old" / "task", simulate_episode(3, 1.767e9, True))
    write_lerobot(root / "lerobot", iter([first, second]))
    return root


@pytest.fixture
def root(recorded_demo: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    return shutil.copytree(recorded_demo, tmp_path / "recordings")


def stored(root: Path, format: str, views: Sequence[str] | None = None) -> Stored:
    """The last of the recordings of a format, extracted with these views."""
    opened = open_recordings([Source(name=format, path=format)], root, views)
    return Stored(opened.recordings[-1], root, views or ("View1", "View2", "View5"))


def expected(one: Stored, view: str, rows: Sequence[int]) -> list[np.ndarray]:
    """The frames by their number on the timeline, not by their time."""
    indices = one.timeline.frames[view][list(rows)].tolist()
    return list(one.recording.cameras()[view].read(indices))


@pytest.mark.parametrize("format", FORMATS)
def test_frames_are_those_that_the_rows_were_made_of(recorded_demo: Path, format: str) -> None:
    one = stored(recorded_demo, format)
    rows = [0, 4, 5, len(one.timeline.vl_time) - 1]
    found = one.frames(rows, recorded_demo)
    assert found.absence == ""
    assert list(found.frames) == ["View1", "View2", "View5"]
    for view, frames in found.frames.items():
        for frame, right in zip(frames, expected(one, view, rows), strict=True):
            np.testing.assert_array_equal(frame, right)
    first, *_, last = found.frames["View2"]
    assert (first != last).any()


@pytest.mark.parametrize("format", ["raw", "lerobot"])
def test_a_recording_that_changed_or_is_gone_shows_nothing(root: Path, format: str) -> None:
    one = stored(root, format)
    kinds = (".npz", ".pkl", ".csv", ".txt")
    file = next(file for file in one.recording.files() if file.suffix in kinds)
    file.write_bytes(file.read_bytes() + b"\n")
    found = one.frames([0], root)
    assert found.frames == {}
    assert f"{root / one.episode.path} changed since" in found.absence
    shutil.rmtree(one.recording.path)
    found = one.frames([0], root)
    assert found.frames == {}
    assert f"no recording at {root / one.episode.path} any more" in found.absence


@pytest.mark.parametrize(
    ("format", "spoil"),
    [
        ("lerobot", lambda path: (path / "meta/info.json").write_text("{")),
        ("new", lambda path: [file.unlink() for file in path.iterdir() if file.is_file()]),
    ],
)
def test_what_cannot_be_read_is_said_in_one_sentence(root, format, spoil):
    one = stored(root, format)
    spoil(one.recording.path)
    found = one.frames([0], root)
    assert found.frames == {}
    assert f"{one.recording.path} cannot be read (" in found.absence
    assert "\n" not in found.absence


def test_a_time_between_two_frames_belongs_to_neither(recorded_demo: Path) -> None:
    one = stored(recorded_demo, "raw")
    one.store.array("vl/frame_time")[2, 1] += 1e-3
    found = one.frames([2], recorded_demo)
    assert found.frames == {}
    assert "View2 has no frames at the times that the store has" in found.absence


def test_views_that_store_or_episode_lacks_are_left_out(recorded_demo: Path) -> None:
    one = stored(recorded_demo, "lerobot", ("View2",))
    found = one.frames([2], recorded_demo)
    assert list(found.frames) == ["View2"]
    np.testing.assert_array_equal(found.frames["View2"][0], expected(one, "View2", [2])[0])
    one = stored(recorded_demo, "raw")
    one.store.array("vl/frame_time")[:, 0] = np.nan
    assert list(one.frames([0, 1], recorded_demo).frames) == ["View2", "View5"]


def test_ticks_are_shown_where_their_frames_are_newest(store: FeatureStore) -> None:
    assert shown_ticks(store, np.arange(31, 60), 4).tolist() == [33, 42, 48, 57]
    assert shown_ticks(store, np.array([31, 32]), 4).tolist() == [31, 32]
    assert shown_ticks(store, np.arange(30), 1).tolist() == [0]
