"""What every reader must keep, whatever the format on disk."""

import pickle
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from pipeline.base.config import Source
from pipeline.data import Recording, open_recordings

FORMATS = {
    "raw": lambda write, folder, truth: write.raw(folder / "Blue_point/data_collection_1", truth),
    "new": lambda write, folder, truth: write.new(folder / "Blue_point/episode_1", truth),
    "old": lambda write, folder, truth: write.old(folder / "White_circle/recv_all_1", truth),
    "lerobot v2.1": lambda write, folder, truth: write.lerobot(folder / "set", "v2.1"),
    "lerobot v3.0, two files": lambda write, folder, truth: write.lerobot(
        folder / "set", "v3.0", file_of=[0, 0, 1]
    ),
    "lerobot v3.0, images": lambda write, folder, truth: write.lerobot(
        folder / "set", "v3.0", image=True
    ),
}
REAL = {
    "real raw": "insertion/raw",
    "real new": "insertion/new",
    "real old": "insertion/old",
    "real v2.1": "lerobot/cr5_banana_v21",
    "real v3.0": "lerobot/cr5_banana_v30_split",
}


@pytest.fixture(params=[*FORMATS, *REAL])
def folder(request, tmp_path, write, truth) -> Path:
    if request.param in REAL:
        return request.getfixturevalue("shared_data") / REAL[request.param]
    FORMATS[request.param](write, tmp_path, truth)
    return tmp_path


@pytest.fixture
def recordings(folder: Path) -> tuple[Recording, ...]:
    return open_recordings([Source(name="s", path=str(folder))], folder).recordings


class TestRecordingContract:
    def test_opening_reads_no_stream_and_no_frame(self, folder: Path, monkeypatch):
        parquet = pq.ParquetFile

        def refuse(*_: object, **__: object) -> None:
            raise AssertionError("a stream was read while opening")

        def meta_only(path: Path) -> pq.ParquetFile:
            assert "meta" in Path(path).parts
            return parquet(path)

        monkeypatch.setattr(np, "load", refuse)
        monkeypatch.setattr(pq, "ParquetFile", meta_only)
        for reading in (
            "insertion.read_csv",
            "pickled.load_plain",
            "jpeg.Image.open",
            "video.av.open",
        ):
            monkeypatch.setattr(f"pipeline.data.{reading}", refuse)
        assert open_recordings([Source(name="s", path=str(folder))], folder).recordings

    def test_opening_again_gives_the_same(self, folder: Path, recordings):
        again = open_recordings([Source(name="s", path=str(folder))], folder).recordings
        assert [(r.id, r.path, r.identity()) for r in again] == [
            (r.id, r.path, r.identity()) for r in recordings
        ]

    def test_is_named_apart(self, recordings: tuple[Recording, ...]):
        assert len({r.id for r in recordings}) == len(recordings)
        assert len({(*r.files(), r.identity()) for r in recordings}) == len(recordings)
        for recording in recordings:
            assert recording.instruction and recording.source == "s" and recording.path.is_dir()

    def test_names_its_views_without_reading_a_stream(self, folder, recordings, monkeypatch):
        expected = [list(recording.cameras()) for recording in recordings]
        (first, *_) = expected[0]
        kept = open_recordings([Source(name="s", path=str(folder))], folder, [first]).recordings
        monkeypatch.setattr(np, "load", None)
        monkeypatch.setattr(pq, "ParquetFile", None)
        monkeypatch.setattr("pipeline.data.insertion.read_csv", None)
        assert [list(recording.view_names()) for recording in recordings] == expected
        assert all(recording.view_names() == [first] for recording in kept)

    def test_can_be_sent_to_another_process(self, recordings: tuple[Recording, ...]):
        for recording in recordings:
            again = pickle.loads(pickle.dumps(recording))
            assert (again.id, again.files()) == (recording.id, recording.files())
            assert again.instruction == recording.instruction

    def test_files_exist_and_are_sorted(self, recordings: tuple[Recording, ...]):
        for recording in recordings:
            files = recording.files()
            assert files == sorted(set(files)) and all(file.is_file() for file in files)

    def test_streams_are_well_formed(self, recordings: tuple[Recording, ...]):
        for recording in recordings:
            streams = [recording.state(), recording.sensor(), recording.poses(), recording.action()]
            assert any(stream is not None for stream in streams)
            for stream in filter(None, streams):
                assert stream.values.dtype == np.float32 and stream.time.dtype == np.float64
                assert stream.values.shape == (len(stream.time), len(stream.channels.names))
                assert len(stream.channels.units) == len(stream.channels.names)
                assert type(stream.values) is np.ndarray and type(stream.time) is np.ndarray
                assert len(stream.time) and (np.diff(stream.time) >= 0).all()
                assert np.isfinite(stream.values).all() and np.isfinite(stream.time).all()

    def test_actions_are_recorded_or_derivable(self, recordings: tuple[Recording, ...]):
        for recording in recordings:
            action, poses = recording.action(), recording.poses()
            assert action is not None or poses is not None
            if action is not None:
                assert action.rate_hz is None or action.rate_hz > 0
            if poses is not None:
                assert poses.channels.units == ("mm",) * 3 + ("deg",) * 3

    def test_clocks_of_one_episode_overlap(self, recordings: tuple[Recording, ...]):
        for recording in recordings:
            clocks = [camera.time for camera in recording.cameras().values()]
            streams = [recording.state(), recording.sensor(), recording.action()]
            clocks += [stream.time for stream in streams if stream is not None]
            assert max(clock[0] for clock in clocks) < min(clock[-1] for clock in clocks)

    def test_cameras_check_and_read(self, recordings: tuple[Recording, ...]):
        for recording in recordings[:2]:
            cameras = recording.cameras()
            assert cameras
            for view, camera in cameras.items():
                assert camera.view == view and not view.startswith("observation")
                assert camera.time.dtype == np.float64 and (np.diff(camera.time) >= 0).all()
                last = len(camera.time) - 1
                indices = [0, 0, 1, last // 2, last, last]
                camera.check(indices)
                frames = list(camera.read(indices))
                assert len(frames) == len(indices)
                assert all(f.dtype == np.uint8 and f.shape == frames[0].shape for f in frames)
                assert np.array_equal(frames[0], frames[1])
                assert np.array_equal(frames[-1], frames[-2])
                alone = next(iter(recording.cameras()[view].read([last])))
                assert np.array_equal(alone, frames[-1])
