"""The new format: row clocks, counts, and the stream that its windows were cut from."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pipeline.base.config import Source
from pipeline.base.errors import RecordingError
from pipeline.data import open_recordings
from pipeline.data.windowed import rebuild


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


@pytest.mark.parametrize(
    ("start_s", "end_s", "robot_hz"),
    [(0, 0.5, 20), (-3600, 0.5, 100), (3600, 0.5, 100), (0, 1.2, 100)],
)
def test_a_made_clock_that_misses_the_end_is_refused(folder, write, only, start_s, end_s, robot_hz):
    """Every row would have another time than it was recorded at, and pair with other frames."""
    start, end = write.START + start_s, write.START + end_s
    write.edit_json(folder / "metadata.json", start_time=start, end_time=end, robot_hz=robot_hz)
    parts = (f"npz: 50 rows.*robot_hz {robot_hz} ", f"{start:.3f}", f"{end:.3f}")
    with pytest.raises(RecordingError, match=".*".join(parts)):
        only(folder).state()


@pytest.mark.parametrize("end_s", [0.1, 0.49, 0.9])
def test_a_made_clock_that_nearly_reaches_the_end_is_taken(folder, write, only, end_s):
    write.edit_json(folder / "metadata.json", end_time=write.START + end_s)
    assert len(only(folder).state().time) == 50


@pytest.mark.parametrize("clocked", [True, False])
def test_states_may_come_as_csv(folder, truth, write, only, clocked):
    (folder / "robot_states.npz").unlink()
    header = [*(["origin_timestamp"] if clocked else []), *write.STATE_NAMES]
    rows = [
        [*([repr(float(time))] if clocked else []), *map(float, row)]
        for time, row in zip(truth.state_time, truth.state, strict=True)
    ]
    write.csv(folder / "robot_states.csv", header, rows)
    if clocked:  # a recorded clock needs no other
        write.edit_json(folder / "metadata.json", end_time=write.START + 60, robot_hz=7)
    state = only(folder).state()
    expected = truth.state_time if clocked else write.START + np.arange(50) / 100
    np.testing.assert_array_equal(state.time, expected)
    np.testing.assert_array_equal(state.values, truth.state)


def test_streams_and_views_may_be_absent(folder, write, only):
    (folder / "robot_states.npz").unlink()
    (folder / "sensor_data.npz").unlink()
    for frame in (folder / "images" / "View2").iterdir():
        frame.unlink()
    with pytest.raises(RecordingError, match=r"robot_states\.npz: 0 rows.*says 50"):
        only(folder).state()
    counts = dict.fromkeys(("robot_states_count", "sensor_windows_count"))
    write.edit_json(folder / "metadata.json", camera_views=["View1"], **counts)
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
        (rewrite_states(robot_states=None, poses=np.zeros((49, 6))), r"joints and poses \(M, 6\)"),
        (rewrite_states(robot_states=None, poses=None), "no member 'poses'"),
        (rewrite_states(robot_states=np.zeros((50, 11))), r"12 values.*\(50, 11\)"),
        (rewrite_states(robot_states=None, joints=None, poses=None), "expected robot_states"),
        (rewrite_states(joints=np.float32(1)), "'joints': expected rows of numbers, found float32"),
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
        ({"timestamps": np.array([0, 2.0, 1]), "data": np.zeros((3, 5, 1026))}, "at row 2"),
        ({"timestamps": np.float32([1e9, 1e9, 1e9]), "data": np.zeros((3, 5, 1026))}, "too coarse"),
        ({"data": np.zeros((3, 5, 1026))}, "no member 'timestamps'"),
        ({"times": np.zeros(3)}, r"expected timestamps or data, found \['times'\]"),
    ],
)
def test_spoilt_windows_are_named(folder, write, only, members, message):
    write.edit_json(folder / "metadata.json", sensor_windows_count=None)
    np.savez(folder / "sensor_data.npz", **members)
    with pytest.raises(RecordingError, match=rf"sensor_data\.npz.*{message}"):
        only(folder).sensor()


@pytest.mark.parametrize("text", ['{"start_time": "noon"}', '{"sensor_hz": NaN}', None])
def test_unreadable_metadata_is_a_bad_episode(folder, text):
    path = folder / "metadata.json"
    path.write_text(text) if text else path.unlink()
    (bad,) = open_recordings([Source(name="s", path=str(folder))], folder).bad
    assert "metadata.json" in bad.reason and (text or "no such file" in bad.reason)


def test_cameras_that_metadata_promises_must_be_there(folder, write, only):
    write.edit_json(folder / "metadata.json", camera_views=["View1", "View7"])
    with pytest.raises(
        RecordingError, match=r"metadata\.json: camera_views has View7, and images/"
    ):
        only(folder).cameras()
    assert list(only(folder, views=["View1"]).cameras()) == ["View1"]


@pytest.mark.parametrize("sensor_hz", [65.0, 550.0])
def test_a_sensor_rate_that_the_overlap_disproves_is_refused(
    tmp_path, write, truth, only, sensor_hz
):
    folder = write.new(tmp_path / "T" / "e", truth, 65, 13)
    write.edit_json(folder / "metadata.json", sensor_hz=sensor_hz)
    with pytest.raises(RecordingError, match=rf"sensor_hz {sensor_hz:g}.* 65\d(\.\d)? would fit"):
        only(folder).sensor()
    write.edit_json(folder / "metadata.json", sensor_hz=630.0)
    assert only(folder).sensor() is not None
    write.edit_json(folder / "metadata.json", sensor_hz=None)
    with pytest.raises(RecordingError, match=r"metadata\.json: windows need a sensor_hz"):
        only(folder).sensor()


def cut(values: np.ndarray, time: np.ndarray, width: int, stride: int):
    stops = np.arange(width, len(values) + 1, stride)
    return time[stops - 1], np.stack([values[stop - width : stop] for stop in stops]), stops[-1]


@settings(deadline=None, max_examples=60)
@given(
    width=st.integers(2, 40),
    overlap=st.floats(0, 0.95),
    windows=st.integers(2, 30),
    jitter=st.floats(0, 0.05),
    hz_error=st.floats(0.98, 1.02),
    held=st.integers(1, 3),
    seed=st.integers(0, 999),
)
@example(width=3, overlap=0.0, windows=2, jitter=0.0, hz_error=1.0, held=2, seed=0)
def test_any_cut_is_undone(width, overlap, windows, jitter, hz_error, held, seed):
    stride = max(1, round(width * (1 - overlap)))
    rng = np.random.default_rng(seed)
    count = width + stride * (windows - 1)
    # A sensor slower than its stream repeats readings.
    values = np.repeat(rng.normal(size=(count, 3)), held, axis=0)[:count]
    time = 100 + np.arange(count) / 650
    ends, data, stop = cut(values, time, width, stride)
    ends = np.sort(ends + rng.uniform(-jitter, jitter, len(ends)) * stride / 650)
    rebuilt_time, rebuilt = rebuild(ends, data, 650 * hz_error, "x")
    if held == 1:
        np.testing.assert_array_equal(rebuilt, values[:stop])
        assert np.abs(rebuilt_time - time[:stop]).max() < (0.11 * stride + 0.03 * width) / 650
    assert len(rebuilt) == len(rebuilt_time)
    assert (np.diff(rebuilt_time) >= 0).all() and rebuilt_time[-1] == ends[-1]


def stream(count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    return np.random.default_rng(0).normal(size=(count, 3)), 50 + np.arange(count) / 100


@pytest.mark.parametrize(("width", "stride"), [(20, 20), (20, 5)])
def test_a_gap_stays_a_gap(width, stride):
    values, time = stream()
    ends, data, _ = cut(values, time, width, stride)
    lost = slice(5, 5 + 2 * width // stride)
    ends, data = np.delete(ends, lost), np.delete(data, lost, axis=0)
    rebuilt_time, rebuilt = rebuild(ends, data, 100.0, "x")
    begin = 5 * stride + width - stride
    first_after = round((ends[5] - 50) * 100) + 1 - width
    np.testing.assert_array_equal(rebuilt, np.delete(values, slice(begin, first_after), axis=0))
    np.testing.assert_allclose(rebuilt_time, np.delete(time, slice(begin, first_after)), atol=1e-9)
    assert np.diff(rebuilt_time).max() > 0.15


def test_a_sensor_that_stands_still_is_cut_by_the_clock():
    time = np.arange(400) / 100
    ends, data, stop = cut(np.zeros((400, 3)), time, 20, 5)
    rebuilt_time, rebuilt = rebuild(ends, data, 100.0, "x")
    assert rebuilt.shape == (stop, 3)
    np.testing.assert_allclose(rebuilt_time, time[:stop], atol=1e-9)


def test_one_window_is_dated_back_from_its_end():
    time, values = rebuild(np.array([10.0]), np.ones((1, 5, 2)), 100.0, "x")
    np.testing.assert_allclose(time, [9.96, 9.97, 9.98, 9.99, 10.0])
    assert values.shape == (5, 2)


def test_overlap_by_the_clock_with_other_readings_is_a_contradiction():
    values, time = stream()
    ends, data, _ = cut(values, time, 20, 5)
    data[9] = np.random.default_rng(1).normal(size=data[9].shape)
    with pytest.raises(RecordingError, match=r"file\.npz: windows 8 and 9 overlap"):
        rebuild(ends, data, 100.0, "file.npz")
