"""The raw format."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.base.config import Source
from pipeline.base.errors import RecordingError
from pipeline.data import open_recordings


@pytest.fixture
def folder(tmp_path: Path, write, truth) -> Path:
    return write.raw(tmp_path / "Blue_point" / "data_collection_1", truth)


def test_streams_are_those_recorded(folder, truth, only):
    recording = only(folder)
    state, sensor, poses = recording.state(), recording.sensor(), recording.poses()
    np.testing.assert_array_equal(state.time, truth.state_time)
    np.testing.assert_array_equal(state.values, truth.state)
    np.testing.assert_array_equal(poses.values, truth.state[:, 6:])
    np.testing.assert_array_equal(sensor.values, truth.sensor)
    np.testing.assert_array_equal(sensor.time, truth.sensor_time)
    assert sensor.channels.names[:2] == ("force", "aline_0000")
    assert sensor.channels.names[-1] == "aline_1024" and sensor.channels.units[:2] == ("N", "")
    assert state.channels.names[5:7] == ("joint_6", "pose_x")
    assert recording.instruction == "Blue point" and recording.action() is None
    assert list(recording.cameras()) == ["View1", "View5"]


def test_columns_go_by_name_not_by_place(folder, write, truth, only):
    names = write.STATE_NAMES[::-1]
    rows = [
        [*map(float, row[::-1]), repr(float(t))]
        for t, row in zip(truth.state_time, truth.state, strict=True)
    ]
    write.csv(folder / "robot_state_x.csv", [*names, "origin_timestamp"], rows)
    np.testing.assert_array_equal(only(folder).state().values, truth.state)


def test_older_sensor_names_are_known(folder, truth, only):
    members = {"force": truth.sensor[:, :1], "aline": truth.sensor[:, 1:]}
    np.savez(folder / "sensor_data_x.npz", timestamps=truth.sensor_time, **members)
    np.testing.assert_array_equal(only(folder).sensor().values, truth.sensor)


def in_whole_seconds(line: str) -> str:
    received, time, *rest = line.split(",")
    return ",".join([received, str(round(float(time))), *rest])


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda ls: [ls[0].replace("pose_b", "pose_q"), *ls[1:]], "one column pose_b each"),
        (lambda ls: [*ls[:4], ls[4].rsplit(",", 1)[0] + ",oops", *ls[5:]], "Row #5.*'oops'"),
        (lambda ls: [*ls[:4], ls[4].rsplit(",", 1)[0] + ",inf", *ls[5:]], "row 3, 0.0.*pose_r"),
        (lambda ls: [*ls[:-1], ls[-1][:60]], "Row #51: Expected 15 columns, got 5"),
        (
            lambda ls: [ls[0], *map(in_whole_seconds, ls[1:])],
            "float64 near .* steps of 1 s, too coarse",
        ),
        (lambda ls: [ls[0], ""], "empty"),
        (lambda ls: [], "one column origin_timestamp"),
    ],
)
def test_a_spoilt_csv_is_named_with_its_place(folder, only, edit, message):
    path = folder / "robot_state_x.csv"
    path.write_text("\n".join(edit(path.read_text().splitlines())))
    with pytest.raises(RecordingError, match=rf"robot_state_x\.csv.*{message}"):
        only(folder).poses()


def damage_member(path: Path, truth) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(bytes(content))


def rewrite(**changes):
    def write_again(path: Path, truth) -> None:
        members = {
            "timestamps": truth.sensor_time,
            "forces": truth.sensor[:, 0],
            "alines": truth.sensor[:, 1:],
        }
        members |= {name: make(members[name]) for name, make in changes.items()}
        np.savez(path, **{name: array for name, array in members.items() if array is not None})

    return write_again


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (damage_member, "member 'alines'.*cannot be read"),
        (rewrite(forces=lambda a: a[:-1]), "325 A-lines but forces of shape"),
        (rewrite(timestamps=lambda a: np.float32(a)), "steps of 128 s, too coarse"),
        (rewrite(alines=lambda a: None), "no member 'alines' or 'aline'"),
        (rewrite(alines=lambda a: a[:, :9]), r"\(N, 1025\).*\(325, 9\)"),
    ],
)
def test_a_spoilt_sensor_file_is_named_with_its_place(folder, truth, only, spoil, message):
    spoil(folder / "sensor_data_x.npz", truth)
    with pytest.raises(RecordingError, match=rf"sensor_data_x\.npz.*{message}"):
        only(folder).sensor()


@pytest.mark.parametrize("twin", ["robot_state_y.csv", "sensor_data_y.npz"])
def test_two_files_where_one_belongs_are_a_bad_episode(folder, twin):
    (folder / twin).touch()
    opened = open_recordings([Source(name="s", path=str(folder))], folder)
    (bad,) = opened.bad
    assert not opened.recordings and bad.where == folder and twin in bad.reason
