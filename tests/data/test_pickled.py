"""The old format: no clock, paths of another machine."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.base.errors import RecordingError


def expect(time: np.ndarray, start: float, rate_hz: float) -> None:
    np.testing.assert_array_equal(time, start + np.arange(len(time)) / rate_hz)


@pytest.mark.parametrize("protocol", [2, 4, 5])
def test_rows_are_at_t0_plus_k_by_rate(tmp_path, write, truth, only, protocol):
    recording = only(write.old(tmp_path / "White" / "recv_all_1", truth, protocol=protocol))
    action, sensor = recording.action(), recording.sensor()
    np.testing.assert_array_equal(action.values, truth.action)
    np.testing.assert_array_equal(sensor.values, truth.sensor[:5])
    expect(action.time, write.START, 10)
    expect(sensor.time, write.START, 10)
    assert (action.kind, action.rate_hz) == ("delta", 10.0)
    assert action.channels.names == ("dx", "dy", "dz", "da", "db", "dr", "gripper")
    assert action.channels.units == ("mm", "mm", "mm", "deg", "deg", "deg", "")
    assert recording.state() is None and recording.poses() is None
    assert recording.instruction == "insert the needle"


def test_frames_recorded_elsewhere_are_found_under_the_folder(tmp_path, write, truth, only):
    recording = only(write.old(tmp_path / "White" / "recv_all_1", truth))
    cameras = recording.cameras()
    assert list(cameras) == ["View1"]  # View3 never came up
    np.testing.assert_allclose(cameras["View1"].time, truth.frame_time, atol=1e-6)
    assert len(cameras["View1"].time) != len(recording.action().time)  # is no error


def test_two_eyes_are_two_views_and_t0_ignores_the_filter(tmp_path, write, truth, only):
    folder = write.old(tmp_path / "White" / "recv_all_1", truth, eyes=("left", "right"))
    assert list(only(folder).cameras()) == ["View1_left", "View1_right"]
    late = (folder / "View1/left").rename(folder / "View1/elsewhere")
    filtered = only(folder, views=["View1_right"])
    assert list(filtered.cameras()) == ["View1_right"] and late.is_dir()
    assert filtered.action().time[0] == write.START


@pytest.mark.parametrize(
    ("recorded", "kept"),
    [
        ("/mnt/robot/recv_all_1/View1/left/z_{t}.jpg", "View1/left/z_{t}.jpg"),
        ("C:\\data\\recv_all_1\\View1\\z_{t}.jpg", "View1/z_{t}.jpg"),
        ("View1/z_{t}.jpg", "View1/z_{t}.jpg"),
        ("/other/View1/z_{t}.jpg", "z_{t}.jpg"),
    ],
)
def test_the_longest_tail_that_exists_is_taken(tmp_path, write, truth, only, recorded, kept):
    folder = tmp_path / "White" / "recv_all_1"
    times = ["10.500", "10.600"]
    for time in times:
        write.jpeg(folder / kept.format(t=time))
    paths = [recorded.format(t=time) for time in times]
    recording = only(write.old(folder, truth, eyes=(), image={"View1": paths}))
    assert recording.cameras()["View1"].time.tolist() == [10.5, 10.6]
    assert recording.action().time[0] == 10.5
    assert all(folder in file.parents for file in recording.files())


def test_a_path_that_exists_as_recorded_is_taken(tmp_path, write, truth, only):
    path = write.jpeg(tmp_path / "elsewhere" / "z_10.5.jpg")
    folder = tmp_path / "White" / "recv_all_1"
    recording = only(write.old(folder, truth, eyes=(), image={"View1": [str(path)]}))
    assert path in recording.files()


@pytest.mark.parametrize(
    "recorded",
    ["../z_10.5.jpg", "x/../../z_10.5.jpg", "/dev/zero_10.5", "/" + "a" * 400 + "_1.5.jpg"],
)
def test_no_path_leads_out_of_the_folder_or_to_a_device(tmp_path, write, truth, only, recorded):
    folder = tmp_path / "White" / "recv_all_1"
    write.jpeg(folder.parent / "z_10.5.jpg")
    recording = only(write.old(folder, truth, eyes=(), image={"View1": [recorded]}))
    with pytest.raises(RecordingError, match=r"data\.pkl, 'image', 'View1', frame 0: .* not there"):
        recording.cameras()


def test_a_missing_frame_is_named(tmp_path, write, truth, only):
    folder = write.old(tmp_path / "White" / "recv_all_1", truth)
    frames = sorted((folder / "View1/left").iterdir())
    frames[2].unlink()
    with pytest.raises(RecordingError, match=rf"data\.pkl.*View1.*frame 2.*{frames[2].name}"):
        only(folder).cameras()


def test_no_image_is_t0_of_zero(tmp_path, write, truth, only):
    recording = only(write.old(tmp_path / "White" / "e", truth, eyes=(), image={}))
    expect(recording.action().time, 0.0, 10)
    assert recording.cameras() == {}


def test_rates_come_from_the_metadata(tmp_path, write, truth, only):
    folder = write.old(
        tmp_path / "White" / "e", truth, metadata={"action_hz": np.float64(5), "robot_hz": 50}
    )
    np.savez(folder / "robot_states.npz", robot_states=truth.state)
    recording = only(folder)
    expect(recording.action().time, write.START, 5)
    expect(recording.sensor().time, write.START, 5)
    expect(recording.state().time, write.START, 50)
    np.testing.assert_array_equal(recording.poses().values, truth.state[:, 6:])


def test_without_metadata_the_defaults_stand(tmp_path, write, truth, only):
    folder = write.old(tmp_path / "White_circle" / "e", truth, metadata=None, instruction="")
    np.savez(folder / "robot_states.npz", robot_states=truth.state)
    recording = only(folder)
    expect(recording.action().time, write.START, 10)
    expect(recording.state().time, write.START, 100)
    assert recording.instruction == "White circle"


@pytest.mark.parametrize("beside", [True, False])
def test_the_sensor_may_be_one_array(tmp_path, write, truth, only, beside):
    inside = None if beside else truth.sensor[:5]
    folder = write.old(tmp_path / "White" / "e", truth, sensor_data=inside)
    if beside:
        assert only(folder).sensor() is None
        np.save(folder / "sensor_data.npy", truth.sensor[:5])
    np.testing.assert_array_equal(only(folder).sensor().values, truth.sensor[:5])


def test_params_may_say_what_the_action_is(tmp_path, write, truth, only):
    folder = write.old(tmp_path / "White" / "e", truth)
    assert only(folder, action_kind="velocity").action().kind == "velocity"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"action": np.zeros((5, 6))}, r"'action': expected shape \(N, 7\), found \(5, 6\)"),
        ({"action": [[0.0] * 7]}, "action: expected an instance of ndarray, found .*Copy"),
        ({"action": np.full((5, 7), np.nan)}, "'action': nan in row 0.*'dx'"),
        ({"action": np.zeros((0, 7))}, "'action': the stream is empty"),
        ({"metadata": [1]}, r"metadata: .*found \[1\].*Copy"),
        ({"metadata": {"action_hz": 0}}, r"metadata\.action_hz: expected .*0\.001, found 0"),
        ({"image": ["a_1.jpg"]}, r"image: .*found \['a_1\.jpg'\]"),
        ({"image": {"View1": [1, 2]}}, r"image\.View1\.0: expected a valid string, found 1"),
        *(
            ({"image": {view: []}}, "image.*expected a name of at most 200 bytes.*found '")
            for view in ("../../up", "/View1", ".View1", "a\\b", "zarr.json", "\u00e9" * 101, "")
        ),
    ],
)
def test_a_spoilt_pickle_is_named(tmp_path, write, truth, only, changes, message):
    folder = write.old(tmp_path / "White" / "e", truth, **changes)
    with pytest.raises(RecordingError, match=rf"data\.pkl.*{message}"):
        only(folder).action()


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        (np.zeros((4, 1026)), "4 sensor rows but 5 actions"),
        (np.zeros((5, 7)), r"\(N, 1026\)"),
        ({"force": np.zeros((5, 1))}, "fpi: missing"),
        ({"force": np.zeros((4, 1)), "fpi": np.zeros((5, 1025))}, "5 A-lines but forces"),
        ("none", "expected an instance of ndarray, found 'none'"),
    ],
)
def test_a_spoilt_sensor_is_named(tmp_path, write, truth, only, sensor, message):
    folder = write.old(tmp_path / "White" / "e", truth, sensor_data=sensor)
    with pytest.raises(RecordingError, match=rf"data\.pkl.*sensor_data.*{message}"):
        only(folder).sensor()


def test_a_pickle_of_something_else_is_named(tmp_path, write, truth, only):
    folder = write.old(tmp_path / "White" / "e", truth)
    (folder / "data.pkl").write_bytes(b"\x80\x04N.")
    with pytest.raises(RecordingError, match=r"data\.pkl: expected an object, found None.*Copy"):
        only(folder).action()


def test_a_truncated_npy_is_named(tmp_path: Path, write, truth, only):
    folder = write.old(tmp_path / "White" / "e", truth, sensor_data=None)
    path = folder / "sensor_data.npy"
    np.save(path, truth.sensor[:5])
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(RecordingError, match=r"sensor_data\.npy.*cannot be read"):
        only(folder).sensor()


def test_a_single_number_is_no_sensor_stream(tmp_path, write, truth, only):
    folder = write.old(tmp_path / "T" / "e", truth, sensor_data=None)
    np.save(folder / "sensor_data.npy", np.float32(1))
    with pytest.raises(RecordingError, match=r"sensor_data\.npy: expected rows of numbers"):
        only(folder).sensor()
