"""LeRobot data sets of the three layouts."""

import json
import os
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.base.config import DataParams, Source
from pipeline.base.digests import file_digest
from pipeline.base.errors import RecordingError
from pipeline.data import content_digest, open_recording, open_recordings
from pipeline.data.lerobot import action_kind
from pipeline.data.lerobot_rows import read_clock
from pipeline.data.timeline import build_timeline
from pipeline.look.recording.episode import view_episode
from pipeline.look.recording.page import find_issues

VERSIONS = ["v2.0", "v2.1", "v3.0"]
LENGTHS = (7, 5, 9)
KEY = "observation.images.top"


def opened(root: Path, **entries):
    return open_recordings([Source(name="s", path=str(root), **entries)], root)


def shades(frames) -> list[int]:
    return [int(frame[-4, -4].mean()) for frame in frames]


@pytest.fixture(params=VERSIONS)
def root(request, tmp_path, write) -> Path:
    return write.lerobot(tmp_path / "set", request.param)


def test_all_layouts_say_the_same(tmp_path, write):
    sets = [
        opened(write.lerobot(tmp_path / version, version)).recordings
        for version in ("v2.0", "v2.1", "v3.0")
    ]
    split = write.lerobot(tmp_path / "split", "v3.0", file_of=[0, 1, 1])
    for one, *others in zip(*sets, opened(split).recordings, strict=True):
        for other in others:
            assert other.id == one.id and other.instruction == one.instruction
            for name in ("state", "action"):
                a, b = getattr(one, name)(), getattr(other, name)()
                np.testing.assert_array_equal(a.values, b.values)
                np.testing.assert_array_equal(a.time, b.time)
                assert a.channels == b.channels
            cameras = one.cameras()["top"], other.cameras()["top"]
            np.testing.assert_array_equal(cameras[0].time, cameras[1].time)
            np.testing.assert_allclose(
                *[shades(c.read(range(len(c.time)))) for c in cameras], atol=3
            )


def test_frames_pair_with_rows_by_number(root, write):
    first = 0
    for recording, length in zip(opened(root).recordings, LENGTHS, strict=True):
        camera = recording.cameras()["top"]
        np.testing.assert_array_equal(camera.time, recording.state().time)
        expected = [write.shade_of(first + row) for row in range(length)]
        np.testing.assert_allclose(shades(camera.read(range(length))), expected, atol=3)
        first += length


def test_the_clock_keeps_its_jitter(root):
    time = opened(root).recordings[2].action().time
    assert np.ptp(np.diff(time)) > 0.01 and time.dtype == np.float64
    assert np.array_equal(time, time.astype(np.float32))


@given(
    fps=st.sampled_from([1, 5, 8, 10, 15, 25, 29.97, 30, 50, 60, 100]),
    dtype=st.sampled_from(["float16", "float32", "float64"]),
    frames=st.integers(-200, 2000),
    decimal=st.none() | st.integers(0, 3000).map(lambda number: number / 100),
    rows=st.integers(1, 300),
)
def test_a_rounded_clock_is_that_of_the_frame_numbers(fps, dtype, frames, decimal, rows):
    """Beginning with any frame, or at any time in hundredths of a second."""
    if dtype == "float16":  # tells frames apart in the first seconds alone
        frames, decimal, rows = max(0, min(frames, 10)), None, min(rows, int(fps))
    numbers = np.arange(rows)
    exact = (frames + numbers) / fps if decimal is None else decimal + numbers / fps
    stored = exact.astype(dtype)
    table = pa.table({"timestamp": stored, "frame_index": numbers + 7})
    np.testing.assert_allclose(read_clock(table, fps, "set"), exact, rtol=0, atol=1e-12)
    without_numbers = read_clock(pa.table({"timestamp": stored}), fps, "set")
    np.testing.assert_array_equal(without_numbers, read_clock(table, fps, "set"))


def test_a_clock_that_leaves_frames_out_goes_by_their_numbers():
    numbers = np.array([4, 5, 6, 9, 10, 30])
    table = pa.table({"timestamp": (numbers / 30).astype(np.float32), "frame_index": numbers})
    np.testing.assert_array_equal(read_clock(table, 30, "set"), numbers / 30)


@pytest.mark.parametrize("spoilt", [0.001, 0.00001])
def test_a_clock_of_which_one_time_is_off_stays_as_stored(spoilt):
    times = (np.arange(60) / 30).astype(np.float32)
    times[40] += spoilt
    table = pa.table({"timestamp": times, "frame_index": np.arange(60)})
    np.testing.assert_array_equal(read_clock(table, 30, "set"), times)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize(
    ("fps", "action_hz"), [(30, 10), (30, 15), (10, 5), (50, 10), (15, 5), (30, 1)]
)
def test_a_set_resampled_by_a_whole_factor_gives_the_exact_rows(
    tmp_path, write, fps, action_hz, dtype
):
    rows, reuse, factor = 92, 3, fps // action_hz
    times = (np.arange(rows) / fps).astype(dtype)
    root = write.lerobot(tmp_path / "set", image=True, lengths=(rows,), timestamp=times)
    write.edit_json(root / "meta/info.json", fps=fps)
    (recording,) = opened(root).recordings
    state = recording.state()
    line = build_timeline(recording, action_hz, reuse, "euler_delta", state)
    exact = np.arange(0, rows, factor)
    np.testing.assert_array_equal(line.action, recording.action().values[exact])
    np.testing.assert_array_equal(line.state_end, exact + 1)
    np.testing.assert_array_equal(line.frames["top"], exact[::reuse])
    shown = recording.cameras()["top"].read(line.frames["top"].tolist())
    assert shades(shown) == [write.shade_of(row) for row in exact[::reuse]]


@pytest.mark.parametrize(
    ("factor", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")]
)
def test_a_clock_that_is_not_in_seconds_is_refused(tmp_path, write, factor, unit):
    times = np.arange(7) / 10 * factor
    for dtype in (np.float32, np.int64):
        root = write.lerobot(tmp_path / dtype.__name__, lengths=(7,), timestamp=times.astype(dtype))
        message = rf"timestamp.*0\.1 s apart.*found 1?.*{unit}.*Divide the column by 1e"
        with pytest.raises(RecordingError, match=message.replace("1e", "1(000|e)")):
            opened(root).recordings[0].action()


def test_the_clock_that_is_computed_is_part_of_the_identity(tmp_path, write):
    """Or a store from before would lend its times; a clock that stays as stored changes nothing."""
    times = np.arange(7) / 10
    sets = [
        write.lerobot(tmp_path / name, lengths=(7,), timestamp=stored)
        for name, stored in (("exact", times.astype(np.float32)), ("as stored", times))
    ]
    exact, stored = (opened(root).recordings[0].identity() for root in sets)
    assert exact == f"{stored} clock=frame_index/fps"


def test_streams_are_described(root):
    recording = opened(root).recordings[0]
    action, state = recording.action(), recording.state()
    assert action.channels.names == ("x", "y", "gripper") and action.channels.units == ("",) * 3
    assert (action.kind, action.rate_hz) == ("absolute", 10.0)
    assert state.channels.names == ("a", "b") and recording.poses() is None
    assert opened(root, action_kind="delta").recordings[0].action().kind == "delta"


@pytest.mark.parametrize(
    ("names", "kind"),
    [
        (["joint_0_vel", "gripper"], "velocity"),
        (["linear_velocity_x"], "velocity"),
        (["delta_x", "delta_y", "gripper"], "delta"),
        (["dx", "dy", "dz", "gripper"], "delta"),
        (["DX", "droll"], "delta"),
        (["x", "y", "dxl_3", "drawer"], "absolute"),
        (["action_0"], "absolute"),
    ],
)
def test_names_tell_the_kind_of_action(names, kind):
    assert action_kind(names) == kind


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (["p", "q"], ("p", "q")),
        ([["p", "q"]], ("p", "q")),
        ({"motors": ["p", "q"]}, ("p", "q")),
        ({"arm": ["p"], "hand": ["q"]}, ("p", "q")),
        ({"p": 0, "q": 1}, ("p", "q")),
        (None, ("state_0", "state_1")),
    ],
)
def test_names_come_in_many_shapes(tmp_path, write, names, found):
    feature = {"dtype": "float32", "shape": [2], "names": names, "units": ["rad", "mm"]}
    root = write.lerobot(tmp_path / "set", features={"observation.state": feature})
    channels = opened(root).recordings[0].state().channels
    assert channels.names == found and channels.units == ("rad", "mm")


@pytest.mark.parametrize(
    ("feature", "message"),
    [
        ({"shape": [2], "names": ["p"]}, "2 values a reading, but 1 names and 2 units"),
        ({"shape": [2], "names": None, "units": ["mm"]}, "but 2 names and 1 units"),
        ({"shape": [2, 3], "names": None}, r"shape: expected a list .*1 item.*found \[2, 3\]"),
        ({"shape": [65_537], "names": None}, "at most 65,536 channels, found 65,537"),
        ({"shape": [3], "names": None}, "2 values in row 0, but its feature has 3"),
    ],
)
def test_a_feature_that_contradicts_itself_is_named(tmp_path, write, feature, message):
    features = {"observation.state": {"dtype": "float32", **feature}}
    root = write.lerobot(tmp_path / "set", features=features)
    with pytest.raises(RecordingError, match=f"observation.state.*{message}"):
        opened(root).recordings[0].state()


def test_a_set_without_state_or_views_or_action(tmp_path, write):
    root = write.lerobot(tmp_path / "a", features={"observation.state": None, KEY: None})
    recording = opened(root).recordings[0]
    assert recording.state() is None and recording.cameras() == {}
    root = write.lerobot(tmp_path / "b", features={"action": None})
    with pytest.raises(RecordingError, match=r"no feature 'action'.*observation\.state"):
        opened(root).recordings[0].action()


@pytest.mark.parametrize("column", ["action", "timestamp"])
@pytest.mark.parametrize("version", VERSIONS)
def test_a_missing_column_is_named(tmp_path, write, column, version):
    root = write.lerobot(tmp_path / "set", version, **{column: None})
    with pytest.raises(RecordingError, match=rf"\.parquet.*missing column '{column}'"):
        opened(root).recordings[0].action()


def test_numbers_in_a_plain_column_are_a_stream_of_one(tmp_path, write):
    feature = {"dtype": "float32", "shape": [1], "names": None}
    root = write.lerobot(
        tmp_path / "set",
        lengths=(7,),
        features={"observation.state": feature},
        **{"observation.state": np.arange(7, dtype=np.float32)},
    )
    assert opened(root).recordings[0].state().values[:, 0].tolist() == list(range(7))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([[0.0, 1.0]] * 6 + [[0.0]], "1 values in row 6"),
        ([[0.0, 1.0]] * 6 + [None], "no value in row 6"),
        ([[0.0, 1.0]] * 6 + [[0.0, None]], "nan in row 6.*'b'"),
        ([["0", "1"]] * 7, "expected numbers, found .*string"),
    ],
)
def test_spoilt_rows_are_named(tmp_path, write, values, message):
    root = write.lerobot(tmp_path / "set", lengths=(7,), **{"observation.state": values})
    with pytest.raises(RecordingError, match=f"episode_000000.*observation.state.*{message}"):
        opened(root).recordings[0].state()


def test_a_clock_that_goes_backwards_is_named(tmp_path, write):
    times = np.array([0, 1, 2, 3, 2.5, 5, 6], np.float32)
    root = write.lerobot(tmp_path / "set", lengths=(7,), timestamp=times)
    for read in (lambda r: r.state(), lambda r: r.cameras()):
        with pytest.raises(RecordingError, match=r"timestamp.*goes backwards at row 4"):
            read(opened(root).recordings[0])


@pytest.mark.parametrize("version", VERSIONS)
def test_a_clock_that_stands_still_is_named(tmp_path, write, version):
    times = np.array([0, 1, 2, 3, 3, 5, 6], np.float32)
    root = write.lerobot(tmp_path / "set", version, lengths=(7,), timestamp=times)
    message = (
        r"\.parquet, episode_000000, 'timestamp'.*still at row 4: 3\.000000 s after 3\.000000 s"
    )
    for read in (lambda r: r.state(), lambda r: r.action(), lambda r: r.cameras()):
        with pytest.raises(RecordingError, match=message):
            read(opened(root).recordings[0])


def test_an_episode_without_rows_is_named(tmp_path, write):
    root = write.lerobot(tmp_path / "set", lengths=(7,))
    path = root / "data/chunk-000/episode_000000.parquet"
    pq.write_table(pq.ParquetFile(path).read().slice(0, 0), path)
    write.jsonl(root / "meta/episodes.jsonl", [{"episode_index": 0, "tasks": [], "length": 0}])
    recording = opened(root).recordings[0]
    for read in (recording.state, recording.action, recording.cameras):
        with pytest.raises(RecordingError, match=r"episode_000000\.parquet: has no row"):
            read()


def test_instructions_go_by_value_of_the_task_index(root, write):
    assert [r.instruction for r in opened(root).recordings] == ["pick", "place", "pick"]
    assert {r.instruction for r in opened(root, instruction="mine").recordings} == {"mine"}


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize("tasks", [[], ["pick", "place"]])
def test_tasks_that_meta_leaves_open_are_asked_of_the_rows(tmp_path, write, version, tasks):
    root = write.lerobot(tmp_path / "set", version)
    if version == "v3.0":
        path = root / "meta/episodes/chunk-000/file-000.parquet"
        rows = [{**row, "tasks": tasks} for row in pq.ParquetFile(path).read().to_pylist()]
        pq.write_table(pa.Table.from_pylist(rows), path)
    else:
        path = root / "meta/episodes.jsonl"
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        write.jsonl(path, [{**row, "tasks": tasks} for row in rows])
    assert [r.instruction for r in opened(root).recordings] == ["pick", "place", "pick"]


@pytest.mark.parametrize("indices", [[3, 3, 3, 7, 7, 7, 7], [99] * 7])
def test_a_task_that_is_not_one_asks_for_an_instruction(tmp_path, write, indices):
    root = write.lerobot(tmp_path / "set", lengths=(7,), task_index=indices)
    path = root / "meta/episodes.jsonl"
    write.jsonl(path, [{"episode_index": 0, "tasks": [], "length": 7}])
    with pytest.raises(RecordingError, match=r"expected one task.*give source 's'"):
        _ = opened(root).recordings[0].instruction


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_images_in_rows_are_read_lazily(tmp_path, write, version):
    root = write.lerobot(tmp_path / "set", version, image=True, lengths=(7, 5, 40))
    camera = opened(root).recordings[2].cameras()["top"]
    indices = [0, 3, 3, 17, 39, 39]
    camera.check(indices)
    assert shades(camera.read(indices)) == [write.shade_of(12 + index) for index in indices]


def test_grey_images_of_16_bits_in_rows_are_shown_in_eight(tmp_path, write):
    cells = [{"bytes": write.png(shade, grey_of_16_bits=True), "path": None} for shade in (30, 200)]
    root = write.lerobot(
        tmp_path / "set", image=True, lengths=(7,), **{KEY: [*cells, *cells * 2, cells[0]]}
    )
    camera = opened(root).recordings[0].cameras()["top"]
    camera.check([0, 1])
    for frame, shade in zip(camera.read([0, 1]), (30, 200), strict=True):
        np.testing.assert_array_equal(frame, write.shaded(shade))


def test_a_spoilt_image_in_a_row_is_named(tmp_path, write):
    whole = write.png(50)
    cells = [{"bytes": whole, "path": None}] * 4 + [{"bytes": whole[:90], "path": None}]
    cells += [{"bytes": None, "path": "a.png"}, {"bytes": whole, "path": None}]
    root = write.lerobot(tmp_path / "set", image=True, lengths=(7,), **{KEY: cells})
    camera = opened(root).recordings[0].cameras()["top"]
    for attempt in (camera.check, lambda indices: list(camera.read(indices))):
        attempt([0, 3, 6])
        with pytest.raises(RecordingError, match=rf"parquet, column '{KEY}', row 4: cannot be"):
            attempt([3, 4])
        with pytest.raises(RecordingError, match=r"row 5.*no image bytes"):
            attempt([3, 5])


def test_the_sidecar_is_the_sensor(root, truth):
    (root / "sensor").mkdir()
    time = np.arange(30) / 50
    save = lambda index, **members: np.savez(root / f"sensor/episode_{index:06d}.npz", **members)  # noqa: E731
    save(0, timestamps=time, values=truth.sensor[:30])
    save(1, timestamps=time, values=truth.sensor[:30, :2])
    save(2, timestamps=time, values=truth.sensor[:30, :2], names=["fx", "fy"], units=["N", "N"])
    recordings = opened(root).recordings
    full, numbered, named = (recording.sensor() for recording in recordings)
    assert full.channels.names[:2] == ("force", "aline_0000") and full.channels.units[0] == "N"
    assert numbered.channels.names == ("sensor_0", "sensor_1")
    assert named.channels.names == ("fx", "fy") and named.channels.units == ("N", "N")
    np.testing.assert_array_equal(named.values, truth.sensor[:30, :2])
    assert all(r.path / "sensor" / f"{r.id}.npz" in r.files() for r in recordings)
    save(0, timestamps=time, values=truth.sensor[:30, :2], names=["fx"])
    with pytest.raises(RecordingError, match="2 values a reading, but 1 names"):
        opened(root).recordings[0].sensor()
    for key, words in (("names", ["f\0x", "fy"]), ("units", ["N", "N" * 10_001])):
        save(0, timestamps=time, values=truth.sensor[:30, :2], **{key: words})
        with pytest.raises(RecordingError, match=rf"{key}': \d: expected a text to .*Copy the"):
            opened(root).recordings[0].sensor()
    save(0, timestamps=time[:-1], values=truth.sensor[:30])
    with pytest.raises(RecordingError, match="30 rows but 29 timestamps"):
        opened(root).recordings[0].sensor()


@pytest.mark.parametrize("name", ["sensor", "state", "frames"])
@pytest.mark.parametrize("kind", ["no such file", "a pipe"])
def test_a_sidecar_that_is_no_file_is_refused_not_absent(root, name, kind):
    path = root / name / "episode_000000.npz"
    path.parent.mkdir()
    os.mkfifo(path) if kind == "a pipe" else path.symlink_to("nowhere")
    recording = opened(root).recordings[0]
    message = rf"{name}/episode_000000\.npz: .*{kind}.*Copy the file again"
    with pytest.raises(RecordingError, match=message):
        content_digest(recording, file_digest)
    if name != "frames":  # of images in rows, which this data set has none of
        with pytest.raises(RecordingError, match=message):
            getattr(recording, name)()


def test_states_faster_than_the_rows_stand_in_a_sidecar(root):
    time, values = np.arange(-3, 60) / 100, np.ones((63, 2), np.float32)
    (root / "state").mkdir()
    path = root / "state" / "episode_000000.npz"
    np.savez(path, timestamps=time, values=values, names=["a", "b"], units=["deg", "mm"])
    recording, other = opened(root).recordings[:2]
    state = recording.state()
    np.testing.assert_array_equal(state.time, time)
    np.testing.assert_array_equal(state.values, values)
    assert (state.channels.names, state.channels.units) == (("a", "b"), ("deg", "mm"))
    assert path in recording.files() and path not in other.files()
    assert len(other.state().time) == LENGTHS[1]
    np.savez(path, timestamps=time, values=values)
    assert opened(root).recordings[0].state().channels.names == ("state_0", "state_1")


@pytest.fixture
def captured(tmp_path, write):
    """`captured(*times)`: a recording whose sidecar says so of the images in its seven rows."""
    root = write.lerobot(tmp_path / "set", "v3.0", image=True)
    (root / "frames").mkdir()

    def of(*times: float):
        np.savez(root / "frames" / "episode_000000.npz", top=np.array(times, np.float64))
        return opened(root).recordings[0]

    return of


def test_rows_whose_images_were_captured_at_one_time_show_one_frame(captured):
    recording = captured(-0.04, -0.04, 0.15, 0.15, 0.15, 0.45, 0.45)
    assert any(file.parent.name == "frames" for file in recording.files())
    camera = recording.cameras()["top"]
    assert camera.time.tolist() == [-0.04, 0.15, 0.45]
    line = build_timeline(recording, None, 2, "rotvec", recording.state())
    assert len(line.time) == 7, "the last frame stands until the last row"
    assert line.frames["top"].tolist() == [0, 1, 1, 2]
    assert line.frame_time["top"].tolist() == [-0.04, 0.15, 0.15, 0.45]
    shown = shades(camera.read([0, 1, 1, 2]))
    assert shown == [shown[0], shown[1], shown[1], shown[3]] and len({*shown}) == 3
    camera.check([0, 2])


def test_a_sidecar_of_frames_that_does_not_fit_is_refused(captured):
    for times, said in (
        ((0.0, 0.1), "7 rows, but times"),
        ((0, 0.1, 0.2, 0.1, 0.4, 0.5, 0.6), "backwards at row 3"),
        ((0, 0.1, 0.25, 0.3, 0.4, 0.5, 0.6), "in row 2 was captured at 0.250000 s"),
    ):
        with pytest.raises(RecordingError, match=said):
            captured(*times).cameras()


def test_the_kind_of_the_actions_may_stand_beside_their_names(root):
    info = root / "meta" / "info.json"
    document = json.loads(info.read_text())
    plain = opened(root).recordings[0]
    assert plain.action().kind == "absolute"
    document["features"]["action"]["kind"] = "delta"
    info.write_text(json.dumps(document))
    told = opened(root).recordings[0]
    assert told.action().kind == "delta"
    assert told.identity().replace(" kind=delta", "") == plain.identity() != told.identity()
    assert opened(root, action_kind="velocity").recordings[0].action().kind == "velocity"
    document["features"]["action"]["kind"] = "sideways"
    info.write_text(json.dumps(document))
    with pytest.raises(
        RecordingError,
        match=r"action\.kind: expected 'absolute', 'velocity' or 'delta', found 'sideways'",
    ):
        opened(root)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_set_says_the_same_beside_a_twin(tmp_path, write, truth, version):
    """Whose episodes take their parents' names: neither sensor nor digest goes by them."""
    alone, twin = (write.lerobot(tmp_path / "sets" / name, version) for name in ("a", "b"))
    for root in (alone, twin):
        (root / "sensor").mkdir()
        path = root / "sensor/episode_000001.npz"
        np.savez(path, timestamps=np.arange(30) / 50, values=truth.sensor[:30])
    one = opened(alone).recordings[1]
    two = opened(tmp_path / "sets").recordings[1]
    assert (one.id, two.id) == ("episode_000001", "a/episode_000001")
    np.testing.assert_array_equal(two.sensor().values, truth.sensor[:30])
    assert content_digest(two, file_digest) == content_digest(one, file_digest)
    again = open_recording(two.path, two.format, two.id)
    assert content_digest(again, file_digest) == content_digest(one, file_digest)


def test_episodes_whose_files_are_absent_are_listed(tmp_path, write):
    root = write.lerobot(tmp_path / "set")
    (root / "data/chunk-000/episode_000001.parquet").unlink()
    (root / f"videos/chunk-000/{KEY}/episode_000002.mp4").unlink()
    found = opened(root)
    assert [r.id for r in found.recordings] == ["episode_000000"]
    assert [line.split()[3].rstrip(",") for line in found.missing] == [
        "episode_000001",
        "episode_000002",
    ]
    assert "episode_000001.parquet" in found.missing[0] and ".mp4" in found.missing[1]
    (root / "data/chunk-000/episode_000000.parquet").unlink()
    with pytest.raises(RecordingError, match="none of the 3 episode"):
        opened(root)


def test_a_video_of_a_view_that_is_not_wanted_may_be_absent(tmp_path, write):
    feature = {"dtype": "video", "shape": [48, 64, 3], "names": None}
    root = write.lerobot(tmp_path / "set", features={"observation.images.side": feature})
    assert len(open_recordings([Source(name="s", path=".")], root, ["top"]).recordings) == 3
    with pytest.raises(RecordingError, match="none of the 3"):
        opened(root)


def test_shared_files_that_are_absent_take_their_episodes_with_them(tmp_path, write):
    root = write.lerobot(tmp_path / "set", "v3.0", file_of=[0, 0, 1])
    (root / f"videos/{KEY}/chunk-000/file-000.mp4").unlink()
    found = opened(root)
    assert [r.id for r in found.recordings] == ["episode_000002"] and len(found.missing) == 2


def edit_v3(root: Path, **columns) -> None:
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.ParquetFile(path).read()
    for name, values in columns.items():
        place = table.column_names.index(name)
        table = table.set_column(place, name, pa.array(values))
    pq.write_table(table, path)


def test_swapped_data_files_are_refused(tmp_path, write):
    root = write.lerobot(tmp_path / "set", lengths=(7, 7, 7))
    one, other = (root / f"data/chunk-000/episode_00000{index}.parquet" for index in (0, 1))
    one.rename(root / "aside"), other.rename(one), (root / "aside").rename(other)
    swapped, _, whole = opened(root).recordings
    for read in (swapped.state, swapped.action, swapped.cameras, swapped.identity):
        with pytest.raises(
            RecordingError,
            match=r"000000\.parquet: has no row of episode 0\. Give the data files their own names",
        ):
            read()
    assert whole.state() is not None


@pytest.mark.parametrize("version", VERSIONS)
def test_rows_out_of_order_are_refused(tmp_path, write, version):
    numbers = [0, 1, 2, 4, 3, 5, 6]
    root = write.lerobot(tmp_path / "set", version, lengths=(7, 7), frame_index=numbers)
    row = 11 if version == "v3.0" else 4
    with pytest.raises(RecordingError, match=rf"row {row}: expected frame_index above 4, found 3"):
        opened(root).recordings[1].action()


@pytest.mark.parametrize("numbers", [np.arange(5, 12), [0, 1, 2, 5, 6, 7, 9], None])
def test_rows_that_were_taken_away_are_no_mistake(tmp_path, write, numbers):
    root = write.lerobot(
        tmp_path / "set",
        lengths=(7,),
        frame_index=numbers,
        **({} if numbers is not None else {"episode_index": None}),
    )
    assert len(opened(root).recordings[0].action().time) == 7


@pytest.mark.parametrize(
    ("columns", "refused"),
    [
        ({f"videos/{KEY}/file_index": [0, 0, 0]}, [0, 1, 2]),
        ({f"videos/{KEY}/file_index": [1, 0, 1]}, [0, 2]),
        ({f"videos/{KEY}/from_timestamp": [0.0, 0.6, 0.0]}, [0, 1]),
    ],
)
def test_frames_that_meta_gives_to_two_episodes_are_refused(tmp_path, write, columns, refused):
    root = write.lerobot(tmp_path / "set", "v3.0", file_of=[0, 0, 1])
    edit_v3(root, **columns)
    for index, recording in enumerate(opened(root).recordings):
        for read in (recording.cameras, recording.identity):
            if index not in refused:
                read()
                continue
            with pytest.raises(
                RecordingError, match=rf"file-00\d\.mp4: .*to episode_00000{index} and to episode_"
            ):
                read()
    without = open_recordings([Source(name="s", path=str(root))], root, []).recordings
    assert [one.cameras() for one in without] == [{}] * 3


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_an_episode_that_is_listed_twice_is_refused(tmp_path, write, version):
    root = write.lerobot(tmp_path / "set", version)
    if version == "v3.0":
        edit_v3(root, episode_index=[0, 1, 1])
    else:
        path = root / "meta/episodes.jsonl"
        path.write_text(path.read_text() + path.read_text().splitlines()[1] + "\n")
    with pytest.raises(RecordingError, match=r"meta/episodes.*once, found episode_000001 twice"):
        opened(root)


def test_two_cameras_that_would_be_one_view_are_refused(tmp_path, write):
    camera = {"dtype": "image", "shape": [48, 64, 3], "names": None}
    root = write.lerobot(tmp_path / "set", features={"observation.top": camera})
    with pytest.raises(
        RecordingError,
        match=rf"info\.json: features '{KEY}' and 'observation\.top'.*view 'top'; rename one",
    ):
        opened(root)
    # A depth map is no view and takes no name.
    depth = {**camera, "info": {"is_depth_map": True}}
    root = write.lerobot(tmp_path / "other", features={"observation.top": depth})
    assert opened(root).recordings[0].view_names() == ["top"]


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize(
    "told",
    [
        {"info": {"is_depth_map": True}},
        {"info": {"video.is_depth_map": True}},
        {"video_info": {"video.is_depth_map": True}},
        {"info": None, "video_info": {"is_depth_map": True}},
    ],
)
def test_a_depth_map_is_no_view(tmp_path, write, version, told):
    key = "observation.images.depth"
    camera = {"dtype": "image", "shape": [48, 64, 3], "names": None}
    root = write.lerobot(tmp_path / "set", version, features={key: {**camera, **told}})
    for recording in opened(root).recordings:
        assert recording.depth_views() == ["depth"]
        assert recording.view_names() == list(recording.cameras()) == ["top"]
    source = [Source(name="s", path=str(root))]
    (first, *_) = open_recordings(source, root, ["top"]).recordings
    assert first.depth_views() == []
    with pytest.raises(
        RecordingError, match=r"info\.json.*data\.views asks for depth.*is_depth_map"
    ):
        open_recordings(source, root, ["top", "depth"])
    plain = write.lerobot(
        tmp_path / "plain", features={key: {**camera, "info": {"is_depth_map": 0}}}
    )
    assert opened(plain).recordings[0].view_names() == ["depth", "top"]


def test_a_stale_file_index_is_seen_through(tmp_path, write):
    root = write.lerobot(tmp_path / "set", "v3.0", file_of=[0, 0, 1])
    good = [r.state().values for r in opened(root).recordings]
    edit_v3(root, **{"data/file_index": [0, 0, 0]})
    recordings = opened(root).recordings
    for recording, values in zip(recordings, good, strict=True):
        np.testing.assert_array_equal(recording.state().values, values)
    assert root / "data/chunk-000/file-001.parquet" in recordings[2].files()
    assert [recording.nominal().mistakes for recording in recordings[:2]] == [(), ()]
    params = DataParams(sources=(Source(name="s", path=str(root)),), action_hz=None)
    (flaw,) = [
        flaw
        for flaw in find_issues(view_episode(recordings[2], params, "rotvec"))
        if flaw.kind == "wrong metadata"
    ]
    assert flaw.episode == "episode_000002" and flaw.severity == "warning"
    named, there = (flaw.message.index(f"data/chunk-000/file-00{file}.parquet") for file in (0, 1))
    assert named < there < flaw.message.index("Correct")
    (root / "data/chunk-000/file-001.parquet").unlink()
    with pytest.raises(RecordingError, match=r"file-000.*no row of episode 2"):
        opened(root).recordings[2].state()
    lost = find_issues(view_episode(opened(root).recordings[2], params, "rotvec"))
    assert [flaw.kind for flaw in lost] == ["unreadable"]


def test_stale_global_indices_do_not_matter(tmp_path, write):
    root = write.lerobot(tmp_path / "set", "v3.0", file_of=[0, 0, 1])
    good = opened(root).recordings[2].state().values
    edit_v3(root, dataset_from_index=[0, 7, 0], dataset_to_index=[7, 12, 9])
    np.testing.assert_array_equal(opened(root).recordings[2].state().values, good)


def test_episodes_name_their_groups(root, write):
    assert [recording.group for recording in opened(root).recordings] == [None] * 3
    groups = ["monday", None, 7]
    if (path := root / "meta/episodes.jsonl").exists():
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        write.jsonl(path, [row | {"group": g} for row, g in zip(rows, groups, strict=True)])
    else:
        path = root / "meta/episodes/chunk-000/file-000.parquet"
        table = pq.ParquetFile(path).read()
        pq.write_table(table.append_column("group", pa.array(["monday", None, "7"])), path)
    assert [recording.group for recording in opened(root).recordings] == ["monday", None, "7"]


def test_row_counts_that_disagree_with_meta_are_named(root, write):
    if (root / "meta/episodes.jsonl").exists():
        rows = [{"episode_index": i, "tasks": ["pick"], "length": 8} for i in range(3)]
        write.jsonl(root / "meta/episodes.jsonl", rows)
    else:
        edit_v3(root, length=[8, 8, 8])
    with pytest.raises(RecordingError, match=r"\.parquet: 7 rows of episode 0.*says 8"):
        opened(root).recordings[0].state()


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_frame_counts_that_disagree_are_found_by_check(tmp_path, write, version):
    root = write.lerobot(tmp_path / "set", version, lengths=(7,))
    (path,) = root.rglob("*.mp4")
    write.video(path, [50] * 6)
    with pytest.raises(RecordingError, match=r"\.mp4: 6 frames of view 'top' but 7 rows"):
        opened(root).recordings[0].cameras()["top"].check([0])


def test_timestamps_of_meta_that_disagree_with_the_rows_are_found_by_check(tmp_path, write):
    root = write.lerobot(tmp_path / "set", "v3.0")
    edit_v3(root, **{f"videos/{KEY}/to_timestamp": [0.6, 1.2, 2.1]})
    with pytest.raises(RecordingError, match="6 frames of view 'top' but 7 rows"):
        opened(root).recordings[0].cameras()["top"].check([0])


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_a_truncated_parquet_is_named(tmp_path, write, version):
    root = write.lerobot(tmp_path / "set", version)
    path = min((root / "data").rglob("*.parquet"))
    path.write_bytes(path.read_bytes()[:-100])
    recording = opened(root).recordings[0]
    for read in (recording.state, recording.action, recording.cameras, recording.files):
        if version == "v2.1" and read == recording.files:
            continue
        with pytest.raises(RecordingError, match=path.name):
            read()


@pytest.mark.parametrize("version", ["v1.6", "v2.2", "v3.1", None, 3])
def test_an_unknown_version_is_refused(tmp_path, write, version):
    root = write.lerobot(tmp_path / "set")
    write.edit_json(root / "meta/info.json", codebase_version=version)
    found = "codebase_version: " + ("missing" if version is None else f".*v3.0', found {version!r}")
    with pytest.raises(
        RecordingError, match=f"'s'.*{found}.*convert the data set with the lerobot"
    ):
        opened(root)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("info.json", "{", "info.json: cannot be read as JSON"),
        ("info.json", "[]", "info.json: expected an object, found.*Mend meta/"),
        ("episodes.jsonl", '{"episode_index": 0, "length": 7}\n{', "episodes.jsonl, line 2"),
        ("episodes.jsonl", '{"length": 7}', "line 1.*episode_index"),
        (
            "episodes.jsonl",
            '{"episode_index": "a", "length": 7}',
            "line 1: episode_index: .*found 'a'",
        ),
        (
            "episodes.jsonl",
            '{"episode_index": 4, "length": 7, "tasks": [5]}',
            r"episodes\.jsonl, line 1: tasks\.0: expected a valid string, found 5",
        ),
        (
            "episodes.jsonl",
            '{"episode_index": 4, "length": 7, "tasks": "pick"}',
            r"episodes\.jsonl, line 1: tasks: .*found 'pick'",
        ),
        ("tasks.jsonl", '{"task": "pick"}', "tasks.jsonl, line 1.*task_index"),
    ],
)
def test_broken_meta_of_v2_is_named(tmp_path, write, file, text, message):
    root = write.lerobot(tmp_path / "set")
    (root / "meta" / file).write_text(text)
    with pytest.raises(RecordingError, match=f"source 's'.*{message}"):
        opened(root)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fps": None}, "fps: missing"),
        ({"fps": 0}, "fps: expected .*found 0"),
        ({"fps": True}, "fps: expected a valid number, found True"),
        ({"fps": 1e300}, r"fps: expected .*found 1e\+300"),
        ({"chunks_size": 0}, "chunks_size: expected .*found 0"),
        ({"chunks_size": 0.5}, "chunks_size: expected .*found 0.5"),
        ({"chunks_size": None}, "chunks_size: missing"),
        ({"features": []}, r"features: expected .*found \[\]"),
        ({"data_path": None}, "data_path: missing"),
        ({"video_path": None}, "video_path: missing, but features has videos"),
    ],
)
def test_broken_info_is_named(tmp_path, write, changes, message):
    root = write.lerobot(tmp_path / "set")
    write.edit_json(root / "meta/info.json", **changes)
    with pytest.raises(RecordingError, match=rf"source 's'.*info\.json: {message}.*Mend meta/"):
        opened(root)


@pytest.mark.parametrize("field", ["from_timestamp", "to_timestamp"])
@pytest.mark.parametrize("value", [np.inf, np.nan, 1e308])
def test_a_video_span_that_is_no_time_is_named(tmp_path, write, field, value):
    root = write.lerobot(tmp_path / "set", "v3.0")
    edit_v3(root, **{f"videos/{KEY}/{field}": [0.7, value, 2.1]})
    place = rf"file-000\.parquet, row 1: videos\.{KEY}\.{field}: expected"
    with pytest.raises(RecordingError, match=place):
        opened(root)


def test_broken_meta_of_v3_is_named(tmp_path, write):
    root = write.lerobot(tmp_path / "set", "v3.0")
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.ParquetFile(path).read()
    pq.write_table(table.drop_columns(["data/file_index"]), path)
    with pytest.raises(
        RecordingError, match=r"file-000\.parquet, row 0: data\.file_index: missing"
    ):
        opened(root)
    edit = table.set_column(1, "length", pa.array([7, None, 9]))
    pq.write_table(edit, path)
    with pytest.raises(RecordingError, match=r"row 1: length: expected .*found None"):
        opened(root)
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(RecordingError, match="cannot be read as parquet"):
        opened(root)
    path.unlink()
    with pytest.raises(RecordingError, match="expected chunk-000/file-000"):
        opened(root)


def test_episodes_files_of_resumed_recordings_are_all_read(tmp_path, write):
    root = write.lerobot(tmp_path / "set", "v3.0")
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.ParquetFile(path).read()
    pq.write_table(table.slice(0, 1), path)
    pq.write_table(table.slice(1), path.with_name("file-001.parquet"))
    assert len(opened(root).recordings) == 3


def feature(dtype: str = "float32", names=("a", "b"), **entries) -> dict:
    return {"dtype": dtype, "shape": [2], "names": list(names), **entries}


@pytest.mark.parametrize("version", VERSIONS)
def test_what_info_says_of_an_episode_is_in_its_identity(tmp_path, write, version):
    root = write.lerobot(tmp_path / "set", version)
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    features = info["features"]
    side = {**features[KEY], "dtype": "image"}

    def identity(views=("top",), **changes) -> str:
        path.write_text(json.dumps({**info, **changes}))
        source = Source(name="s", path=str(root))
        return open_recordings([source], root, views).recordings[1].identity()

    renamed = {**features, "action": {**features["action"], "names": ["x", "y", "z"]}}
    identities = [
        identity(),
        identity(fps=20),
        identity(features=renamed),
        identity(features={**features, "observation.state": feature(units=["rad", "rad"])}),
        identity(features={**features, "observation.state": feature("float64")}),
        identity(views=("top", "side"), features={**features, "observation.images.side": side}),
    ]
    assert len(set(identities)) == len(identities)
    assert identities[0] == identity(
        total_episodes=99,
        features={**dict(reversed(features.items())), "observation.images.side": side},
    )


def test_adding_an_episode_leaves_the_files_of_the_others_alone(tmp_path, write):
    small = opened(write.lerobot(tmp_path / "a", lengths=(7, 5))).recordings
    large = opened(write.lerobot(tmp_path / "b", lengths=(7, 5, 9))).recordings
    for one, other in zip(small, large, strict=False):
        assert [p.name for p in one.files()] == [p.name for p in other.files()]
        assert one.identity() == other.identity()
        assert not any("meta" in path.parts for path in one.files())


META_MEND = r".*Mend meta/, or convert the data set with the lerobot release that wrote it"
FILE_MEND = r".*Copy the file again, or leave the episode out"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"fps": 1' + "0" * 400 + "}", ".*fps: expected a finite number, found 1000"),
        ('{"codebase_version": "\\ud800"}', "cannot be read as JSON: .*hex escape"),
        ("null", "expected an object, found None"),
    ],
)
def test_an_info_that_is_no_document_is_named(tmp_path, write, text, message):
    root = write.lerobot(tmp_path / "set")
    (root / "meta/info.json").write_text(text)
    with pytest.raises(RecordingError, match=rf"info\.json: ({message}){META_MEND}"):
        opened(root)


@pytest.mark.parametrize("name", ["data_path", "video_path"])
@pytest.mark.parametrize(
    "path",
    [
        "{episode_index:3000000000d}",
        "{episode_index.__class__}",
        "{episode_index[0]}",
        "{episode_index!r}",
        "{episode_index:{episode_chunk}d}",
        "{nonsense}",
        "{chunk_index}",
        "{}",
        "data/{episode_index",
        "/etc/{episode_index}",
        "data/../../{episode_index}",
        "data/\x00{episode_index}",
    ],
)
def test_a_path_that_leaves_the_data_set_is_refused(tmp_path, write, name, path):
    root = write.lerobot(tmp_path / "set")
    write.edit_json(root / "meta/info.json", **{name: path})
    with pytest.raises(RecordingError, match=rf"info\.json: {name}: expected .*found{META_MEND}"):
        opened(root)


@pytest.mark.parametrize(
    "key",
    [f"observation.images.{view}" for view in ("a/b", "..", "", ".hidden")] + ["a\\b", ".."],
)
@pytest.mark.parametrize("dtype", ["video", "image"])
def test_a_camera_that_cannot_be_a_file_is_refused(tmp_path, write, key, dtype):
    features = {key: {"dtype": dtype, "shape": [48, 64, 3], "names": None}}
    root = write.lerobot(tmp_path / "set", features=features)
    message = rf"info\.json: features: a camera cannot have the name.*{META_MEND}"
    with pytest.raises(RecordingError, match=message):
        opened(root)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"units": 5}, "units: expected .*found 5"),
        ({"units": [None, "mm"]}, r"units\.0: expected a valid string, found None"),
        ({"dtype": 5}, "dtype: expected a valid string, found 5"),
        ({"info": {"is_depth_map": "some"}}, r"info\.is_depth_map: expected .*found 'some'"),
    ],
)
def test_a_feature_of_wrong_types_is_named(tmp_path, write, entries, message):
    described = {"dtype": "float32", "shape": [2], "names": None, **entries}
    root = write.lerobot(tmp_path / "set", features={"observation.state": described})
    place = rf"info\.json: features\.observation\.state\.{message}"
    with pytest.raises(RecordingError, match=f"{place}{META_MEND}"):
        opened(root)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"shape": [2_000_000_000]}, r"shape\.0: expected less than 1000000000, found 2000000000"),
        ({"shape": [True]}, r"shape\.0: expected a valid integer, found True"),
        ({"shape": None}, "shape: expected .*found None"),
        ({"names": 5}, "names: expected .*found 5"),
        ({"names": "ab"}, "names: expected .*found 'ab'"),
        ({"names": [1, 2]}, r"names\.0: expected a valid string, found 1"),
        ({"names": [[["a"]], "b"]}, r"names\.0: expected a valid string, found \['a'\]"),
        ({"names": ["a" * 10_001, "b"]}, r"names\.0: expected .* at most 10000 characters"),
    ],
)
def test_shape_and_names_are_judged_of_what_is_read(tmp_path, write, entries, message):
    described = {"dtype": "float32", "shape": [2], "names": None, **entries}
    root = write.lerobot(
        tmp_path / "set", features={"observation.state": described, "never_read": described}
    )
    recording = opened(root).recordings[0]
    assert len(recording.action().values) == 7
    with pytest.raises(RecordingError, match=rf"info\.json, 'observation\.state': {message}"):
        recording.state()


def replace_column(root, column, cells):
    """Of the rows of `meta/episodes` of a set of three episodes."""
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.ParquetFile(path).read()
    if column in table.column_names:
        table = table.drop_columns([column])
    pq.write_table(table.append_column(column, pa.array(cells)), path)


@pytest.mark.parametrize("column", ["episode_index", "length", "data/chunk_index"])
def test_whole_numbers_may_be_stored_as_floats(tmp_path, write, column):
    root = write.lerobot(tmp_path / "set", "v3.0")
    cells = pq.ParquetFile(root / "meta/episodes/chunk-000/file-000.parquet").read()[column]
    replace_column(root, column, cells.cast(pa.float64()).to_pylist())
    assert [len(recording.action().values) for recording in opened(root).recordings] == [7, 5, 9]


@pytest.mark.parametrize(
    ("column", "cells", "message"),
    [
        ("episode_index", ["0", "1", "2"], r"episode_index: expected a valid integer, found '0'"),
        ("episode_index", [True, False, True], "episode_index: expected .*found True"),
        ("episode_index", [-1, 1, 2], "episode_index: expected greater .*found -1"),
        ("length", [10**12, 5, 9], "length: expected less than 1000000000, found 1000000000000"),
        ("length", [[7], [5], [9]], r"length: expected a valid integer, found \[7\]"),
        ("data/chunk_index", [0.5, 0.0, 0.0], r"data\.chunk_index: expected .*found 0\.5"),
        ("tasks", ["a", "b", "c"], "tasks: expected .*found 'a'"),
        ("tasks", [["x" * 10_001]] * 3, r"tasks\.0: expected .*at most 10000 characters"),
        ("group", [True, False, True], "group.*found True"),
    ],
)
def test_rows_of_meta_of_wrong_types_are_named(tmp_path, write, column, cells, message):
    root = write.lerobot(tmp_path / "set", "v3.0")
    replace_column(root, column, cells)
    with pytest.raises(RecordingError, match=rf"file-000\.parquet, row 0: {message}{META_MEND}"):
        opened(root)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize(
    ("tasks", "message"),
    [
        ([{"task_index": 0, "task": None}], "task: expected a valid string, found None"),
        ([{"task_index": 0, "task": 5}], "task: expected a valid string, found 5"),
        ([{"task_index": "0", "task": "a"}], "task_index: expected .*found '0'"),
        ([{"task_index": -1, "task": "a"}], "task_index: expected .*found -1"),
        ([{"task_index": 0}], "task: missing"),
        (
            [{"task_index": 7, "task": "a"}, {"task_index": 7, "task": "b"}],
            "expected each task once, found 7 twice",
        ),
    ],
)
def test_broken_tasks_are_named(tmp_path, write, version, tasks, message):
    root = write.lerobot(tmp_path / "set", version)
    if version == "v3.0":
        pq.write_table(pa.Table.from_pylist(tasks), root / "meta/tasks.parquet")
    else:
        write.jsonl(root / "meta/tasks.jsonl", tasks)
    with pytest.raises(RecordingError, match=rf"meta/tasks\.\w+(, \w+ \d)?: {message}{META_MEND}"):
        opened(root)


def zeros(rows: int) -> pa.ChunkedArray:
    """As many in memory as on disk: next to nothing."""
    return pa.chunked_array([pa.array(np.zeros(1_000_000, np.int8))] * (rows // 1_000_000))


def test_tables_that_unpack_to_more_than_the_limits_are_refused_unread(tmp_path, write):
    names = ("episode_index", "length", "data/chunk_index", "data/file_index")
    root = write.lerobot(tmp_path / "v3", "v3.0", image=True)
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    pq.write_table(pa.table({name: zeros(20_000_000) for name in names}), path)
    unpacked = r"parquet: expected at most 268,435,456 bytes unpacked, found.*raise limits\.ratio"
    with pytest.raises(RecordingError, match=unpacked):
        opened(root)
    root = write.lerobot(tmp_path / "v2")
    names = ("episode_index", "timestamp")
    pq.write_table(
        pa.table({name: zeros(20_000_000) for name in names}),
        root / "data/chunk-000/episode_000000.parquet",
    )
    with pytest.raises(RecordingError, match=unpacked):
        opened(root).recordings[0].state()
    opened_wide = opened(root, limits={"ratio": 1e6}).recordings[0]
    with pytest.raises(RecordingError, match="20000000 rows of episode 0, but meta/ says 7"):
        opened_wide.state()


def test_a_list_of_episodes_that_never_ends_is_refused(tmp_path, write, monkeypatch):
    monkeypatch.setattr("pipeline.data.lerobot_meta._MOST_ROWS", 2)
    with pytest.raises(
        RecordingError, match=r"meta: expected at most 2 episodes .*Split the data set"
    ):
        opened(write.lerobot(tmp_path / "set"))


@pytest.mark.parametrize(
    ("cells", "found"),
    [
        (["a"] * 7, "string"),
        ([True] * 7, "bool"),
        ([[[1.0, 2.0]]] * 7, "list<"),
        ([{"a": 1}] * 7, "struct<"),
        (pa.array(["a"] * 7).dictionary_encode(), "dictionary<"),
        (pa.array([1] * 7, pa.timestamp("ns")), "timestamp"),
        ([None] * 7, "null"),
    ],
)
@pytest.mark.parametrize(
    "column", ["observation.state", "timestamp", "frame_index", "episode_index"]
)
def test_columns_that_are_no_numbers_are_named(tmp_path, write, column, cells, found):
    root = write.lerobot(tmp_path / "set", lengths=(7,), **{column: cells})
    message = rf"000000\.parquet, column '{column}': expected numbers, found '.*{found}{FILE_MEND}"
    with pytest.raises(RecordingError, match=message):
        opened(root).recordings[0].state()


def test_a_column_that_stands_twice_is_named(tmp_path, write):
    root = write.lerobot(tmp_path / "set", lengths=(7,))
    path = root / "data/chunk-000/episode_000000.parquet"
    table = pq.ParquetFile(path).read()
    pq.write_table(table.append_column("action", table["action"]), path)
    with pytest.raises(
        RecordingError, match=r"one column 'action', found more\. Write the file again"
    ):
        opened(root).recordings[0].action()


@pytest.mark.parametrize("times", [[1e300 * n for n in range(7)], [-1e308, *range(5), 1e308]])
def test_a_clock_that_no_seconds_have_is_named(tmp_path, write, times):
    root = write.lerobot(tmp_path / "set", lengths=(7,), timestamp=times)
    message = rf"'timestamp': expected seconds, found -?1e\+30\d in row \d{FILE_MEND}"
    with pytest.raises(RecordingError, match=message):
        opened(root).recordings[0].state()


@pytest.mark.parametrize(
    ("file", "version"),
    [
        ("meta/episodes.jsonl", "v2.1"),
        ("meta/tasks.jsonl", "v2.1"),
        ("meta/tasks.parquet", "v3.0"),
        ("meta/episodes/chunk-000/file-000.parquet", "v3.0"),
        ("data/chunk-000/episode_000000.parquet", "v2.1"),
        ("data/chunk-000/file-000.parquet", "v3.0"),
    ],
)
def test_what_is_no_file_is_named(tmp_path, write, file, version):
    root = write.lerobot(tmp_path / "set", version, lengths=(7,))
    for make, found in ((Path.mkdir, "a folder"), (os.mkfifo, "a pipe, socket or device")):
        (root / file).rename(tmp_path / "aside") if (root / file).is_file() else None
        make(root / file)
        with pytest.raises(RecordingError, match=rf"{file}: expected a file, found {found}"):
            opened(root)
        (root / file).rmdir() if (root / file).is_dir() else (root / file).unlink()


def test_videos_of_one_path_are_refused(tmp_path, write):
    root = write.lerobot(tmp_path / "set")
    write.edit_json(
        root / "meta/info.json", video_path=f"videos/chunk-000/{KEY}/episode_000000.mp4"
    )
    message = r"000000\.mp4: meta/ gives frames of .* to episode_00000\d and to episode_00000\d too"
    for recording in opened(root).recordings:
        with pytest.raises(RecordingError, match=message):
            recording.cameras()
