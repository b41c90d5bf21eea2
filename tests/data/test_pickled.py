"""The old format: no clock, paths of another machine, and an unpickler that runs nothing."""

import io
import pickle
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest

from pipeline.base.errors import RecordingError
from pipeline.data.pickled import load_plain


@pytest.fixture
def old(tmp_path, write, truth, only):
    """`old(**entries)`: the recording of a pickle with these entries."""

    def of(eyes=("left",), **entries):
        folder = tmp_path / "White_circle" / "recv_all_1"
        return only(write.old(folder, truth, eyes, **entries))

    return of


def expect(time: np.ndarray, start: float, rate_hz: float) -> None:
    np.testing.assert_array_equal(time, start + np.arange(len(time)) / rate_hz)


def test_rows_are_at_t0_plus_k_by_rate(old, write, truth):
    recording = old()
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


def test_frames_recorded_elsewhere_are_found_under_the_folder(old, truth):
    recording = old()
    cameras = recording.cameras()
    assert list(cameras) == ["View1"]  # View3 has no frame
    np.testing.assert_allclose(cameras["View1"].time, truth.frame_time, atol=1e-6)
    assert len(cameras["View1"].time) != len(recording.action().time)  # is no error


def test_no_image_is_t0_of_zero(old):
    recording = old(eyes=(), image={})
    expect(recording.action().time, 0.0, 10)
    assert recording.cameras() == {}


def test_two_eyes_are_two_views_and_t0_ignores_the_filter(old, write, only):
    recording = old(eyes=("left", "right"))
    assert list(recording.cameras()) == ["View1_left", "View1_right"]
    (recording.path / "View1/left").rename(recording.path / "View1/elsewhere")
    filtered = only(recording.path, views=["View1_right"])
    assert list(filtered.cameras()) == ["View1_right"]
    assert filtered.action().time[0] == write.START


def test_the_longest_tail_of_a_path_of_windows_is_taken(tmp_path, old, write):
    folder = tmp_path / "White_circle" / "recv_all_1"
    times = ["10.500", "10.600"]
    for time in times:
        write.jpeg(folder / f"View1/z_{time}.jpg")
    recorded = [f"C:\\data\\recv_all_1\\View1\\z_{time}.jpg" for time in times]
    recording = old(eyes=(), image={"View1": recorded})
    assert recording.cameras()["View1"].time.tolist() == [10.5, 10.6]
    assert recording.action().time[0] == 10.5
    assert all(folder in file.parents for file in recording.files())


def test_a_path_that_exists_as_recorded_is_taken(tmp_path, old, write):
    path = write.jpeg(tmp_path / "elsewhere" / "z_10.5.jpg")
    assert path in old(eyes=(), image={"View1": [str(path)]}).files()


@pytest.mark.parametrize(
    "recorded", ["x/../../z_10.5.jpg", "/dev/zero_10.5", "/" + "a" * 400 + "_1.5.jpg"]
)
def test_no_path_leads_out_of_the_folder_or_to_a_device(tmp_path, old, write, recorded):
    write.jpeg(tmp_path / "White_circle" / "z_10.5.jpg")
    recording = old(eyes=(), image={"View1": [recorded]})
    with pytest.raises(RecordingError, match=r"data\.pkl, 'image', 'View1', frame 0: .* not there"):
        recording.cameras()


@pytest.mark.parametrize(
    ("metadata", "rates"),
    [({"action_hz": np.float64(5), "robot_hz": 50}, (5, 50)), (None, (10, 100))],
)
def test_rates_come_from_the_metadata_or_are_the_recorders(old, write, truth, metadata, rates):
    recording = old(metadata=metadata, instruction="")
    np.savez(recording.path / "robot_states.npz", robot_states=truth.state)
    expect(recording.action().time, write.START, rates[0])
    expect(recording.sensor().time, write.START, rates[0])
    expect(recording.state().time, write.START, rates[1])
    np.testing.assert_array_equal(recording.poses().values, truth.state[:, 6:])
    assert recording.instruction == "White circle"


def test_the_sensor_may_be_one_array_in_the_pickle_or_beside_it(old, truth):
    inside = old(sensor_data=truth.sensor[:5])
    np.testing.assert_array_equal(inside.sensor().values, truth.sensor[:5])
    recording = old(sensor_data=None)
    assert recording.sensor() is None
    path = recording.path / "sensor_data.npy"
    np.save(path, truth.sensor[:5])
    np.testing.assert_array_equal(recording.sensor().values, truth.sensor[:5])
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(RecordingError, match=r"sensor_data\.npy.*cannot be read"):
        recording.sensor()


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"action": np.zeros((5, 6))}, r"'action': expected shape \(N, 7\), found \(5, 6\)"),
        ({"action": [[0.0] * 7]}, "action: expected an instance of ndarray, found .*Copy"),
        ({"action": np.full((5, 7), np.nan)}, "'action': nan in row 0.*'dx'"),
        ({"metadata": {"action_hz": 0}}, r"metadata\.action_hz: expected .*0\.001, found 0"),
        ({"image": {"View1": [1, 2]}}, r"image\.View1\.0: expected a valid string, found 1"),
        ({"image": {"../../up": []}}, "image.*expected a name of at most 200 bytes.*found '"),
    ],
)
def test_a_spoilt_pickle_is_named(old, entries, message):
    with pytest.raises(RecordingError, match=rf"data\.pkl.*{message}"):
        old(**entries).action()


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        (np.zeros((4, 1026)), "4 sensor rows but 5 actions"),
        (np.zeros((5, 7)), r"\(N, 1026\)"),
        ({"force": np.zeros((5, 1))}, "fpi: missing"),
        ({"force": np.zeros((4, 1)), "fpi": np.zeros((5, 1025))}, "5 A-lines but forces"),
    ],
)
def test_a_spoilt_sensor_is_named(old, sensor, message):
    with pytest.raises(RecordingError, match=rf"data\.pkl.*sensor_data.*{message}"):
        old(sensor_data=sensor).sensor()


def load(path: Path) -> object:
    return load_plain(path, 2**30)


def save(path: Path, content: object, protocol: int = 4) -> Path:
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    return path


CONTENT = {
    "float32": np.arange(6, dtype=np.float32).reshape(2, 3),
    "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "big-endian": np.arange(3, dtype=">f8"),
    "integers": np.arange(3),
    "words": np.array(["a", "bc"]),
    "view": np.arange(10.0)[::2],
    "plain": [1, 2.5, None, True, "ü", b"\x00\xff", (1, (2,)), {1, 2}, OrderedDict(a=1, b=[2])],
    "scalars": [np.float32(1.5), np.int64(7), np.float64(0.1)],
}


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_arrays_containers_and_scalars_come_back(tmp_path, protocol):
    loaded = load(save(tmp_path / "data.pkl", CONTENT, protocol))
    assert loaded.keys() == CONTENT.keys()
    for name, value in CONTENT.items():
        if isinstance(value, np.ndarray):
            assert isinstance(loaded[name], np.ndarray), name
            assert loaded[name].dtype.kind == value.dtype.kind, name
            np.testing.assert_array_equal(loaded[name], value)
        else:
            assert loaded[name] == value


def test_numpy_1_spelling_is_known(tmp_path):
    content = pickle.dumps(np.arange(3.0), protocol=3)
    assert b"numpy._core" in content
    path = tmp_path / "data.pkl"
    path.write_bytes(content.replace(b"numpy._core", b"numpy.core"))
    np.testing.assert_array_equal(load(path), np.arange(3.0))


def global_call(module: str, name: str, *arguments: object) -> bytes:
    """A protocol-3 pickle that calls `module.name(*arguments)`."""
    body = io.BytesIO()
    pickle._Pickler(body, 3).save(arguments)  # type: ignore[attr-defined]
    return b"\x80\x03c" + f"{module}\n{name}\n".encode() + body.getvalue() + b"R."


@pytest.mark.parametrize(
    ("module", "name", "arguments"),
    [
        ("posix", "system", ("touch {mark}",)),
        ("__builtin__", "eval", ("open('{mark}', 'w')",)),
        ("numpy", "load", ("{mark}",)),
        ("numpy", "memmap", ("{mark}", "u1", "w+", 0, (4,))),
        ("numpy.testing._private.utils", "runstring", ("open('{mark}', 'w')", {})),
        ("numpy.core.multiarray", "os.system", ("touch {mark}",)),
        ("numpy", "dtype", ("O8", False, True)),  # of an array of objects
        ("_codecs", "encode", ("x", "rot13")),
    ],
)
def test_a_hostile_pickle_is_refused_and_nothing_runs(tmp_path, module, name, arguments):
    mark = tmp_path / "mark"
    filled = [a.format(mark=mark) if isinstance(a, str) else a for a in arguments]
    path = tmp_path / "data.pkl"
    path.write_bytes(global_call(module, name, *filled))
    with pytest.raises(RecordingError, match=r"data\.pkl: refused.*Nothing was executed"):
        load(path)
    assert not mark.exists()


def test_what_a_pickle_sets_on_an_admitted_name_does_not_outlive_it(tmp_path):
    path = tmp_path / "data.pkl"
    # (numpy.dtype).__setstate__((None, {"func": 1})), then .keywords and so on.
    path.write_bytes(b"\x80\x02cnumpy\ndtype\n(N}U\x04func\x94K\x01su\x86b.")
    with pytest.raises(RecordingError):
        load(path)
    kept = save(tmp_path / "kept.pkl", np.arange(3.0))
    np.testing.assert_array_equal(load(kept), np.arange(3.0))


def test_memory_of_another_array_is_not_shared(tmp_path):
    """Otherwise a state set on the other array later could free it."""
    path = tmp_path / "data.pkl"
    call = ("numpy.core.numeric", "_frombuffer", np.zeros(3), np.dtype("f8"), (3,), "C")
    path.write_bytes(global_call(*call))
    with pytest.raises(RecordingError, match=r"refused.*shares the memory of another"):
        load(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (pickle.dumps({"action": np.arange(100.0)})[:200], ""),
        (b"\x80\x02U\x05mesh1Q.", "UnpicklingError"),  # a persistent id
        (b"\x80\x05\x97.", "UnpicklingError"),  # a buffer out of band
        (  # a shape of more than the bytes hold
            pickle.dumps(np.arange(4, dtype=np.int16), 4).replace(b"K\x04\x85", b"K\xff\x85"),
            ".*buffer size does not match",
        ),
    ],
)
def test_damage_is_named_and_accuses_nobody(tmp_path, content, message):
    path = tmp_path / "data.pkl"
    path.write_bytes(content)
    with pytest.raises(
        RecordingError, match=rf"data\.pkl: damaged pickle: {message}.*Copy or write"
    ):
        load(path)


def test_a_file_above_the_limit_is_not_read(tmp_path):
    path = save(tmp_path / "data.pkl", np.zeros(1000))
    with pytest.raises(RecordingError, match=r"data\.pkl: .*limits\.array_bytes"):
        load_plain(path, 1000)
