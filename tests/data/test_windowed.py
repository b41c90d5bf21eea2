"""The new format: windows, row clocks, counts."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.base.config import Source
from pipeline.base.errors import RecordingError
from pipeline.data import open_recordings


@pytest.fixture
def folder(tmp_path: Path, write, truth) -> Path:
    return write.new(tmp_path / "Blue_point" / "episode_1", truth)


@pytest.mark.parametrize(("width", "stride"), [(65, 65), (65, 13), (130, 65), (325, 1)])
def test_the_stream_is_rebuilt_without_duplicates(tmp_path, write, truth, only, width, stride):
    sensor = only(write.new(tmp_path / "T" / "e", truth, width, stride)).sensor()
    np.testing.assert_array_equal(sensor.values, truth.sensor[: len(sensor.values)])
    np.testing.assert_allclose(sensor.time, truth.sensor_time[: len(sensor.time)], atol=1e-6)
    assert len(sensor.values) >= len(truth.sensor) - stride


def test_rows_without_a_clock_start_at_start_time(folder, truth, write, only):
    state = only(folder).state()
    np.testing.assert_array_equal(state.values, truth.state)
    np.testing.assert_array_equal(state.time, write.START + np.arange(50) / 100)


def test_joints_and_poses_make_a_state(folder, truth, only):
    np.savez(folder / "robot_states.npz", joints=truth.state[:, :6], poses=truth.state[:, 6:])
    np.testing.assert_array_equal(only(folder).state().values, truth.state)


@pytest.mark.parametrize("format", ["npz", "csv"])
@pytest.mark.parametrize(
    ("start_s", "end_s", "robot_hz"),
    [(0, 0.5, 20), (-3600, 0.5, 100), (3600, 0.5, 100), (0, 1.2, 100)],
)
def test_a_made_clock_that_misses_the_end_is_refused(
    folder, truth, write, only, format, start_s, end_s, robot_hz
):
    """Every row would be dated otherwise than it was recorded, and pair with other frames."""
    if format == "csv":
        (folder / "robot_states.npz").unlink()
        write.csv(folder / "robot_states.csv", write.STATE_NAMES, truth.state.tolist())
    start, end = write.START + start_s, write.START + end_s
    write.edit_json(folder / "metadata.json", start_time=start, end_time=end, robot_hz=robot_hz)
    with pytest.raises(RecordingError) as refused:
        only(folder).state()
    for part in (
        f"robot_states.{format}: 50 rows",
        f"start_time {start:.3f}",
        f"end_time {end:.3f}",
        f"robot_hz {robot_hz}",
    ):
        assert part in str(refused.value)


@pytest.mark.parametrize("end_s", [0.1, 0.49, 0.9])
def test_a_made_clock_that_nearly_reaches_the_end_is_taken(folder, write, only, end_s):
    write.edit_json(folder / "metadata.json", end_time=write.START + end_s)
    assert len(only(folder).state().time) == 50


def test_a_recorded_clock_needs_no_other(folder, truth, write, only):
    (folder / "robot_states.npz").unlink()
    rows = np.column_stack([truth.state_time, truth.state.astype(np.float64)]).tolist()
    write.csv(folder / "robot_states.csv", ["origin_timestamp", *write.STATE_NAMES], rows)
    write.edit_json(folder / "metadata.json", end_time=write.START + 60, robot_hz=7)
    np.testing.assert_array_equal(only(folder).state().time, truth.state_time)


@pytest.mark.parametrize("clocked", [True, False])
def test_states_may_come_as_csv(folder, truth, write, only, clocked):
    (folder / "robot_states.npz").unlink()
    header = [*(["origin_timestamp"] if clocked else []), *write.STATE_NAMES]
    rows = [
        [*([repr(float(time))] if clocked else []), *map(float, row)]
        for time, row in zip(truth.state_time, truth.state, strict=True)
    ]
    write.csv(folder / "robot_states.csv", header, rows)
    state = only(folder).state()
    expected = truth.state_time if clocked else write.START + np.arange(50) / 100
    np.testing.assert_array_equal(state.time, expected)
    np.testing.assert_array_equal(state.values, truth.state)


def test_streams_and_views_may_be_absent(folder, write, only):
    (folder / "robot_states.npz").unlink()
    (folder / "sensor_data.npz").unlink()
    for frame in (folder / "images" / "View2").iterdir():
        frame.unlink()
    write.edit_json(folder / "metadata.json", camera_views=["View1"])
    recording = only(folder)
    assert recording.state() is None and recording.sensor() is None and recording.poses() is None
    assert list(recording.cameras()) == ["View1"]


def test_the_instruction_is_metadata_else_folder_else_overridden(folder, write, only):
    assert only(folder).instruction == "Blue point"
    write.edit_json(folder / "metadata.json", instruction="touch the blue point")
    assert only(folder).instruction == "touch the blue point"
    assert only(folder, instruction="mine").instruction == "mine"


def rewrite_states(**changes):
    def spoil(folder: Path, truth) -> None:
        members = {
            "robot_states": truth.state,
            "joints": truth.state[:, :6],
            "poses": truth.state[:, 6:],
        }
        np.savez(
            folder / "robot_states.npz",
            **{k: v for k, v in (members | changes).items() if v is not None},
        )

    return spoil


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (rewrite_states(poses=np.zeros((49, 6))), "50 joints, 49 poses"),
        (rewrite_states(robot_states=None, poses=None), "no member 'poses'"),
        (rewrite_states(robot_states=np.zeros((50, 11))), r"12 values.*\(50, 11\)"),
        (rewrite_states(robot_states=None, joints=None, poses=None), "expected robot_states"),
        (rewrite_states(robot_states=np.float32(1)), "'robot_states': expected rows of numbers"),
        (rewrite_states(joints=np.float32(1)), "'joints': expected rows of numbers, found .* 1"),
        (rewrite_states(robot_states=np.full((50, 12), np.inf)), "inf in row 0.*joint_1"),
    ],
)
def test_spoilt_states_are_named(folder, truth, only, spoil, message):
    spoil(folder, truth)
    with pytest.raises(RecordingError, match=rf"robot_states\.npz.*{message}"):
        only(folder).state()


@pytest.mark.parametrize(
    ("changes", "stream", "message"),
    [
        ({"robot_states_count": 51}, "state", "50 rows.*robot_states_count.*51"),
        ({"sensor_windows_count": 6}, "sensor", "5 rows.*sensor_windows_count.*6"),
        ({"start_time": None}, "state", "start_time and robot_hz"),
        ({"robot_hz": None}, "state", "start_time and robot_hz"),
    ],
)
def test_metadata_that_contradicts_the_arrays(folder, write, only, changes, stream, message):
    write.edit_json(folder / "metadata.json", **changes)
    with pytest.raises(RecordingError, match=message):
        getattr(only(folder), stream)()


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"timestamps": np.arange(3.0), "data": np.zeros((4, 5, 1026))}, "4 windows but 3"),
        ({"timestamps": np.arange(3.0), "data": np.zeros((3, 5, 9))}, r"\(N, W, 1026\)"),
        (
            {"timestamps": np.array([0, 2.0, 1]), "data": np.zeros((3, 5, 1026))},
            "backwards at row 2",
        ),
        ({"data": np.zeros((3, 5, 1026))}, "no member 'timestamps'"),
        ({"times": np.zeros(3)}, "expected timestamps or data, found times"),
    ],
)
def test_spoilt_windows_are_named(folder, write, only, members, message):
    write.edit_json(folder / "metadata.json", sensor_windows_count=None)
    np.savez(folder / "sensor_data.npz", **members)
    with pytest.raises(RecordingError, match=rf"sensor_data\.npz.*{message}"):
        only(folder).sensor()


@pytest.mark.parametrize(
    "text",
    [
        '{"start_time": "noon"}',
        '{"robot_hz": 0}',
        '{"sensor_hz": NaN}',
        '{"robot_hz": true}',
    ],
)
def test_unreadable_metadata_is_a_bad_episode(folder, text):
    (folder / "metadata.json").write_text(text)
    (bad,) = open_recordings([Source(name="s", path=str(folder))], folder).bad
    assert "metadata.json" in bad.reason


def test_a_lost_metadata_file_is_a_bad_episode(folder):
    (folder / "metadata.json").unlink()
    (bad,) = open_recordings([Source(name="s", path=str(folder))], folder).bad
    assert "metadata.json" in bad.reason and "no such file" in bad.reason


@pytest.mark.parametrize("sensor_hz", [65.0, 550.0, 6500.0])
def test_a_sensor_rate_that_the_overlap_disproves_is_refused(
    tmp_path, write, truth, only, sensor_hz
):
    folder = write.new(tmp_path / "T" / "e", truth, 65, 13)
    write.edit_json(folder / "metadata.json", sensor_hz=sensor_hz)
    with pytest.raises(
        RecordingError, match=rf"65\d(\.\d)? Hz.*sensor_hz.*{sensor_hz:g}; they must"
    ):
        only(folder).sensor()
    write.edit_json(folder / "metadata.json", sensor_hz=630.0)
    assert only(folder).sensor() is not None
