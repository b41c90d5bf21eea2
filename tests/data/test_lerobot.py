"""LeRobot data sets of the three layouts."""

import json
import os
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.base.config import Source
from pipeline.base.digests import file_digest
from pipeline.base.errors import RecordingError
from pipeline.data import content_digest, open_recordings
from pipeline.data.lerobot import action_kind
from pipeline.data.lerobot_rows import read_clock
from pipeline.data.timeline import build_timeline
from tests.data.conftest import EPISODES_V3, VIEW_KEY, edit_v3, open_all

VERSIONS = ["v2.0", "v2.1", "v3.0"]
LENGTHS = (7, 5, 9)
META_MEND = r".*Mend meta/, or convert the data set with the lerobot release that wrote it"

refused = partial(pytest.raises, RecordingError)


def shades(frames) -> list[int]:
    return [int(frame[-4, -4].mean()) for frame in frames]


def vector(**entries) -> dict:
    """A feature of two numbers, with these entries."""
    return {"dtype": "float32", "shape": [2], "names": None, **entries}


def camera(dtype: str = "image", **entries) -> dict:
    return {"dtype": dtype, "shape": [48, 64, 3], "names": None, **entries}


@pytest.fixture(params=VERSIONS)
def root(request, tmp_path, write) -> Path:
    return write.lerobot(tmp_path / "set", request.param)


@pytest.fixture
def seven(tmp_path, write):
    """`seven(column=cells)`: a data set of one episode of seven rows, with these columns."""
    made = iter(range(99))
    return lambda version="v2.1", **columns: write.lerobot(
        tmp_path / f"set {next(made)}", version, lengths=(7,), **columns
    )


def test_all_layouts_give_the_same_episodes(tmp_path, write):
    sets = [open_all(write.lerobot(tmp_path / version, version)) for version in VERSIONS]
    sets.append(open_all(write.lerobot(tmp_path / "split", "v3.0", file_of=[0, 1, 1])))
    first = 0
    for number, episodes in enumerate(zip(*sets, strict=True)):
        reference = episodes[0]
        state, action = reference.state(), reference.action()
        assert reference.instruction == ("pick", "place", "pick")[number]
        assert action.channels.names == ("x", "y", "gripper") and action.channels.units == ("",) * 3
        assert (action.kind, action.rate_hz) == ("absolute", 10.0)
        assert state.channels.names == ("a", "b") and reference.poses() is None
        assert np.ptp(np.diff(state.time)) > 0.01, "the clock keeps its jitter"
        assert np.array_equal(state.time, state.time.astype(np.float32))
        expected = [write.shade_of(first + row) for row in range(LENGTHS[number])]
        first += LENGTHS[number]
        for episode in episodes:
            assert (episode.id, episode.instruction) == (reference.id, reference.instruction)
            for stream, other in ((episode.state(), state), (episode.action(), action)):
                np.testing.assert_array_equal(stream.values, other.values)
                np.testing.assert_array_equal(stream.time, other.time)
                assert stream.channels == other.channels
            view = episode.cameras()["top"]
            np.testing.assert_array_equal(view.time, state.time)
            np.testing.assert_allclose(shades(view.read(range(len(expected)))), expected, atol=3)


@given(
    fps=st.sampled_from([1, 5, 8, 10, 15, 25, 29.97, 30, 50, 60, 100]),
    dtype=st.sampled_from(["float16", "float32", "float64"]),
    frames=st.integers(-200, 2000),
    decimal=st.none() | st.integers(0, 3000).map(lambda number: number / 100),
    rows=st.integers(1, 300),
)
def test_a_rounded_clock_is_that_of_the_frame_numbers(fps, dtype, frames, decimal, rows):
    """It begins with any frame, or at any time in hundredths of a second."""
    if dtype == "float16":  # it tells frames apart in the first seconds alone
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


@pytest.mark.parametrize(
    ("times", "message"),
    [
        (np.float32([0, 1, 2, 3, 2.5, 5, 6]), r"goes backwards at row 4"),
        (np.float32([0, 1, 2, 3, 3, 5, 6]), r"still at row 4: 3\.000000 s after 3\.000000 s"),
        ([-1e308, *range(5), 1e308], r"timestamp -1e\+308 in row 0, expected seconds"),
    ],
)
def test_a_clock_that_is_none_is_named(seven, times, message):
    recording = open_all(seven("v3.0", timestamp=times))[0]
    place = rf"\.parquet, episode_000000, 'timestamp': .*{message}"
    for read in (recording.state, recording.action, recording.cameras):
        with refused(match=place):
            read()


def test_the_clock_that_is_computed_is_part_of_the_identity(seven):
    """Or a store from before would lend its times; a clock that stays as stored changes nothing."""
    times = np.arange(7) / 10
    sets = [seven(timestamp=stored) for stored in (times.astype(np.float32), times)]
    exact, stored = (open_all(root)[0].identity() for root in sets)
    assert exact == f"{stored} clock=frame_index/fps"


@pytest.mark.parametrize(
    ("names", "kind"),
    [
        (["joint_0_vel", "gripper"], "velocity"),
        (["delta_x", "delta_y", "gripper"], "delta"),
        (["DX", "droll"], "delta"),
        (["x", "y", "dxl_3", "drawer"], "absolute"),
    ],
)
def test_names_tell_the_kind_of_action(names, kind):
    assert action_kind(names) == kind


@pytest.mark.parametrize(
    ("names", "read"),
    [
        ([["p", "q"]], ("p", "q")),
        ({"arm": ["p"], "hand": ["q"]}, ("p", "q")),
        ({"p": 0, "q": 1}, ("p", "q")),
        (None, ("state_0", "state_1")),
    ],
)
def test_names_come_in_many_shapes(seven, names, read):
    root = seven(features={"observation.state": vector(names=names, units=["rad", "mm"])})
    channels = open_all(root)[0].state().channels
    assert channels.names == read and channels.units == ("rad", "mm")


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"names": ["p"]}, "2 values a reading, but 1 names and 2 units"),
        ({"names": ["p", "p"]}, r"each channel name once, found \['p'\]"),
        ({"names": "ab"}, "names: expected .*found 'ab'"),
        ({"shape": [2, 3]}, r"shape: expected a list .*1 item.*found \[2, 3\]"),
        ({"shape": [65_537]}, "at most 65,536 channels, found 65,537"),
    ],
)
def test_a_feature_is_judged_where_it_is_read(seven, entries, message):
    features = {"observation.state": vector(**entries), "never_read": vector(**entries)}
    recording = open_all(seven(features=features))[0]
    assert len(recording.action().values) == 7
    with refused(match=f"observation.state.*{message}"):
        recording.state()


def test_a_set_without_state_or_views_or_action(seven):
    recording = open_all(seven(features={"observation.state": None, VIEW_KEY: None}))[0]
    assert recording.state() is None and recording.cameras() == {}
    with refused(match=r"no feature 'action'.*observation\.state"):
        open_all(seven(features={"action": None}))[0].action()


@pytest.mark.parametrize("column", ["action", "timestamp"])
def test_a_missing_column_is_named(seven, column):
    with refused(match=rf"\.parquet.*missing column '{column}'"):
        open_all(seven(**{column: None}))[0].action()


def test_numbers_in_a_plain_column_are_a_stream_of_one(seven):
    cells = {"observation.state": np.arange(7, dtype=np.float32)}
    root = seven(features={"observation.state": vector(shape=[1])}, **cells)
    assert open_all(root)[0].state().values[:, 0].tolist() == list(range(7))


@pytest.mark.parametrize(
    ("column", "cells", "message"),
    [
        ("observation.state", [[0.0, 1.0]] * 6 + [[0.0]], "1 values in row 6"),
        ("observation.state", [[0.0, 1.0]] * 6 + [None], "no value in row 6"),
        ("observation.state", [[0.0, 1.0]] * 6 + [[0.0, None]], "nan in row 6.*'b'"),
        ("frame_index", [None] * 7, "expected numbers, found 'null"),
    ],
)
def test_spoilt_rows_are_named(seven, column, cells, message):
    with refused(match=rf"episode_000000.*'{column}'.*{message}"):
        open_all(seven(**{column: cells}))[0].state()


def edit_episodes(root: Path, write, **columns) -> None:
    """Replace a key of every episode in `meta/`, of any version."""
    if (path := root / "meta/episodes.jsonl").exists():
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        for name, cells in columns.items():
            rows = [row | {name: cell} for row, cell in zip(rows, cells, strict=True)]
        return write.jsonl(path, rows)
    return edit_v3(root, **columns)


@pytest.mark.parametrize("tasks", [[[]] * 3, [["pick", "place"]] * 3])
def test_tasks_that_meta_leaves_open_are_read_from_the_rows(root, write, tasks):
    edit_episodes(root, write, tasks=pa.array(tasks, pa.list_(pa.string())).to_pylist())
    assert [r.instruction for r in open_all(root)] == ["pick", "place", "pick"]


@pytest.mark.parametrize("indices", [[3, 3, 3, 7, 7, 7, 7], [99] * 7])
def test_a_task_that_is_not_one_asks_for_an_instruction(seven, write, indices):
    root = seven(task_index=indices)
    edit_episodes(root, write, tasks=[[]])
    with refused(match=r"expected one task.*give source 's'"):
        _ = open_all(root)[0].instruction


def test_images_in_rows_are_read_lazily(tmp_path, write):
    root = write.lerobot(tmp_path / "set", "v3.0", image=True, lengths=(7, 5, 40))
    view = open_all(root)[2].cameras()["top"]
    indices = [0, 3, 3, 17, 39, 39]
    view.check(indices)
    assert shades(view.read(indices)) == [write.shade_of(12 + index) for index in indices]


def test_a_spoilt_image_in_a_row_is_named(seven, write):
    whole = {"bytes": write.png(50), "path": None}
    cut, empty = {"bytes": write.png(50)[:90], "path": None}, {"bytes": None, "path": "a.png"}
    cells = [*[whole] * 4, cut, empty, whole]
    view = open_all(seven(image=True, **{VIEW_KEY: cells}))[0].cameras()["top"]
    for attempt in (view.check, lambda indices: list(view.read(indices))):
        attempt([0, 3, 6])
        with refused(match=rf"parquet, column '{VIEW_KEY}', row 4: cannot be"):
            attempt([3, 4])
        with refused(match=r"row 5.*no image bytes"):
            attempt([3, 5])


def save_sidecar(root: Path, name: str, index: int, **members) -> Path:
    path = root / name / f"episode_{index:06d}.npz"
    path.parent.mkdir(exist_ok=True)
    np.savez(path, **members)
    return path


def test_the_sidecar_is_the_sensor(root, truth):
    save = partial(save_sidecar, root, "sensor")
    clock = {"timestamps": np.arange(30) / 50}
    files = [
        save(0, **clock, values=truth.sensor[:30]),
        save(1, **clock, values=truth.sensor[:30, :2]),
        save(2, **clock, values=truth.sensor[:30, :2], names=["fx", "fy"], units=["N", "N"]),
    ]
    recordings = open_all(root)
    full, numbered, named = (recording.sensor() for recording in recordings)
    assert full.channels.names[:2] == ("force", "aline_0000") and full.channels.units[0] == "N"
    assert numbered.channels.names == ("sensor_0", "sensor_1")
    assert named.channels.names == ("fx", "fy") and named.channels.units == ("N", "N")
    np.testing.assert_array_equal(named.values, truth.sensor[:30, :2])
    assert all(file in r.files() for file, r in zip(files, recordings, strict=True))
    for changes, message in (
        ({"names": ["fx"]}, "2 values a reading, but 1 names"),
        ({"names": ["f\0x", "fy"]}, r"names': 0: expected a text to .*Copy or"),
        ({"timestamps": np.arange(29)}, "30 rows but 29 timestamps"),
    ):
        save(0, **{**clock, "values": truth.sensor[:30, :2], **changes})
        with refused(match=message):
            recordings[0].sensor()


@pytest.mark.parametrize(("name", "kind"), [("sensor", "no such file"), ("state", "a pipe")])
def test_a_sidecar_that_is_no_file_is_refused_not_absent(seven, name, kind):
    root = seven()
    path = root / name / "episode_000000.npz"
    path.parent.mkdir()
    os.mkfifo(path) if kind == "a pipe" else path.symlink_to("nowhere")
    recording = open_all(root)[0]
    message = rf"{name}/episode_000000\.npz: .*{kind}.*Copy or write the file again"
    with refused(match=message):
        content_digest(recording, file_digest)
    with refused(match=message):
        getattr(recording, name)()


def test_states_faster_than_the_rows_are_in_a_sidecar(root):
    members = {"timestamps": np.arange(-3, 60) / 100, "values": np.ones((63, 2), np.float32)}
    path = save_sidecar(root, "state", 0, **members, names=["a", "b"], units=["deg", "mm"])
    recording, other = open_all(root)[:2]
    state = recording.state()
    np.testing.assert_array_equal(state.time, members["timestamps"])
    np.testing.assert_array_equal(state.values, members["values"])
    assert (state.channels.names, state.channels.units) == (("a", "b"), ("deg", "mm"))
    assert path in recording.files() and path not in other.files()
    assert len(other.state().time) == LENGTHS[1]


@pytest.fixture
def captured(tmp_path, write):
    """`captured(*times)`: a recording whose sidecar has these capture times of its images."""
    root = write.lerobot(tmp_path / "set", "v3.0", image=True)

    def of(*times: float):
        save_sidecar(root, "frames", 0, top=np.array(times, np.float64))
        return open_all(root)[0]

    return of


def test_rows_whose_images_were_captured_at_one_time_show_one_frame(captured):
    recording = captured(-0.04, -0.04, 0.15, 0.15, 0.15, 0.45, 0.45)
    assert any(file.parent.name == "frames" for file in recording.files())
    view = recording.cameras()["top"]
    assert view.time.tolist() == [-0.04, 0.15, 0.45]
    line = build_timeline(recording, None, 2, "rotvec", recording.state())
    assert len(line.time) == 7, "the last frame stands until the last row"
    assert line.frames["top"].tolist() == [0, 1, 1, 2]
    assert line.frame_time["top"].tolist() == [-0.04, 0.15, 0.15, 0.45]
    shown = shades(view.read([0, 1, 1, 2]))
    assert shown == [shown[0], shown[1], shown[1], shown[3]] and len({*shown}) == 3
    view.check([0, 2])


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ((0.0, 0.1), "7 rows, but times"),
        ((0, 0.1, 0.2, 0.1, 0.4, 0.5, 0.6), "backwards at row 3"),
        ((0, 0.1, 0.25, 0.3, 0.4, 0.5, 0.6), "in row 2 was captured at 0.250000 s"),
    ],
)
def test_a_sidecar_of_frames_that_does_not_fit_is_refused(captured, times, message):
    with refused(match=message):
        captured(*times).cameras()


def test_the_kind_of_the_actions_may_stand_beside_their_names(root):
    info = root / "meta" / "info.json"
    document = json.loads(info.read_text())
    plain = open_all(root)[0]
    document["features"]["action"]["kind"] = "delta"
    info.write_text(json.dumps(document))
    marked = open_all(root)[0]
    assert (plain.action().kind, marked.action().kind) == ("absolute", "delta")
    assert marked.identity().replace(" kind=delta", "") == plain.identity() != marked.identity()
    assert open_all(root, action_kind="velocity")[0].action().kind == "velocity"
    document["features"]["action"]["kind"] = "sideways"
    info.write_text(json.dumps(document))
    with refused(match=r"action\.kind: expected 'absolute', 'velocity' or 'delta', found 'sidew"):
        open_all(root)


def test_episodes_whose_files_are_absent_are_listed(tmp_path, write):
    root = write.lerobot(tmp_path / "set")
    (root / "data/chunk-000/episode_000001.parquet").unlink()
    (root / f"videos/chunk-000/{VIEW_KEY}/episode_000002.mp4").unlink()
    opened = open_recordings([Source(name="s", path=".")], root)
    assert [r.id for r in opened.recordings] == ["episode_000000"]
    data, video = opened.missing
    assert "lists episode_000001" in data and "episode_000001.parquet" in data
    assert "lists episode_000002" in video and ".mp4" in video
    assert len(open_recordings([Source(name="s", path=".")], root, []).recordings) == 2
    (root / "data/chunk-000/episode_000000.parquet").unlink()
    with refused(match="none of the 3 episode"):
        open_all(root)


def test_swapped_data_files_are_refused(tmp_path, write):
    root = write.lerobot(tmp_path / "set", lengths=(7, 7, 7))
    first, other = (root / f"data/chunk-000/episode_00000{index}.parquet" for index in (0, 1))
    first.rename(root / "aside"), other.rename(first), (root / "aside").rename(other)
    swapped, _, whole = open_all(root)
    for read in (swapped.state, swapped.action, swapped.cameras, swapped.identity):
        with refused(match=r"000000\.parquet: has no row of episode 0\. Give the data files their"):
            read()
    assert whole.state() is not None


def test_rows_out_of_order_are_refused(tmp_path, write):
    numbers = [0, 1, 2, 4, 3, 5, 6]
    root = write.lerobot(tmp_path / "set", "v3.0", lengths=(7, 7), frame_index=numbers)
    with refused(match="row 11: expected frame_index above 4, found 3"):
        open_all(root)[1].action()


@pytest.mark.parametrize(
    "columns",
    [{"frame_index": [0, 1, 2, 5, 6, 7, 9]}, {"frame_index": None}, {"episode_index": None}],
)
def test_rows_that_were_taken_away_are_no_mistake(seven, columns):
    assert len(open_all(seven(**columns))[0].action().time) == 7


@pytest.mark.parametrize(
    "columns",
    [
        {f"videos/{VIEW_KEY}/file_index": [0, 0, 0]},
        {f"videos/{VIEW_KEY}/file_index": [1, 0, 1]},
        {f"videos/{VIEW_KEY}/from_timestamp": [0.0, 0.6, 0.0]},
    ],
)
def test_frames_that_meta_gives_to_two_episodes_are_refused(tmp_path, write, columns):
    root = write.lerobot(tmp_path / "set", "v3.0", file_of=[0, 0, 1])
    edit_v3(root, **columns)
    with refused(match=r"meta/episodes: episode_.* and episode_.* have the same frames of .*mp4"):
        open_all(root)
    assert [recording.cameras() for recording in open_all(root, [])] == [{}] * 3


def test_spans_that_all_begin_late_are_refused(tmp_path, write):
    """Every episode would get frames of the next, and only the last would lack some."""
    root = write.lerobot(tmp_path / "set", "v3.0")
    late = {"from_timestamp": [0.1, 0.8, 1.3], "to_timestamp": [0.8, 1.3, 2.2]}
    edit_v3(root, **{f"videos/{VIEW_KEY}/{name}": times for name, times in late.items()})
    with refused(match=r"meta/episodes: expected from_timestamp.*frames 0 to 20 .*found 1 to 21"):
        open_all(root)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_an_episode_that_is_listed_twice_is_refused(tmp_path, write, version):
    root = write.lerobot(tmp_path / "set", version)
    edit_episodes(root, write, episode_index=[0, 1, 1])
    with refused(match=r"meta/episodes.*once, found episode_000001 twice"):
        open_all(root)


def test_two_cameras_that_would_be_one_view_are_refused(seven):
    with refused(match=rf"features '{VIEW_KEY}' and 'observation\.top'.*view 'top'; rename one"):
        open_all(seven(features={"observation.top": camera()}))
    # A depth map is no view and takes no name.
    root = seven(features={"observation.top": camera(info={"is_depth_map": True})})
    assert open_all(root)[0].view_names() == ["top"]


def test_a_depth_map_is_no_view(seven):
    depth = camera(video_info={"video.is_depth_map": 1})
    root = seven(features={"observation.images.depth": depth})
    for recording in open_all(root):
        assert recording.view_names() == list(recording.cameras()) == ["top"]


def test_a_stale_file_index_is_seen_through(tmp_path, write):
    root = write.lerobot(tmp_path / "set", "v3.0", file_of=[0, 0, 1])
    good = [r.state().values for r in open_all(root)]
    # Nothing reads the indices over the whole data set.
    stale = {"data/file_index": [0, 0, 0], "dataset_from_index": [0, 7, 0]}
    edit_v3(root, **stale)
    recordings = open_all(root)
    for recording, values in zip(recordings, good, strict=True):
        np.testing.assert_array_equal(recording.state().values, values)
    assert root / "data/chunk-000/file-001.parquet" in recordings[2].files()
    (root / "data/chunk-000/file-001.parquet").unlink()
    with refused(match=r"file-000.*no row of episode 2, nor has any other file"):
        open_all(root)[2].state()


def test_episodes_name_their_groups(root, write):
    assert [recording.group for recording in open_all(root)] == [None] * 3
    edit_episodes(root, write, group=["monday", None, "7"])
    assert [recording.group for recording in open_all(root)] == ["monday", None, "7"]


def test_row_counts_that_disagree_with_meta_are_named(root, write):
    edit_episodes(root, write, length=[8, 8, 8])
    with refused(match=r"\.parquet: 7 rows of episode 0.*says 8"):
        open_all(root, [])[0].state()


def test_a_truncated_parquet_is_named(tmp_path, write):
    root = write.lerobot(tmp_path / "set", "v3.0")
    path = min((root / "data").rglob("*.parquet"))
    path.write_bytes(path.read_bytes()[:-100])
    recording = open_all(root)[0]
    for read in (recording.state, recording.action, recording.cameras, recording.files):
        with refused(match=path.name):
            read()


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("info.json", "{", "info.json: cannot be read as JSON"),
        ("episodes.jsonl", '{"episode_index": 0, "length": 7}\n{', "episodes.jsonl, line 2"),
        ("tasks.jsonl", '{"task": "pick"}', "tasks.jsonl, line 1.*task_index"),
        (
            "tasks.jsonl",
            '{"task_index": 7, "task": "a"}\n{"task_index": 7, "task": "b"}',
            r"tasks\.jsonl: expected each task once, found 7 twice",
        ),
    ],
)
def test_broken_meta_of_v2_is_named(seven, file, text, message):
    root = seven()
    (root / "meta" / file).write_text(text)
    with refused(match=f"source 's'.*{message}{META_MEND}"):
        open_all(root)


def feature(key="a", **entries) -> dict:
    return {"features": {key: {"dtype": "float32", **entries}}}


OUTSIDE = (
    "{episode_index:3000000000d} {episode_index.__class__} {episode_index!r} {chunk_index} "
    "{episode_index:{episode_chunk}d} data/{episode_index /etc/{episode_index} "
    "data/../../{episode_index} data/\0{episode_index}"
)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"codebase_version": "v2.2"}, "codebase_version: .*v3.0', found 'v2.2'"),
        ({"fps": 0}, "fps: expected .*found 0"),
        ({"video_path": None}, "video_path: missing, but features has videos"),
        ({"video_path": "{video_key.__class__}"}, "video_path: expected .*found"),
        *(({"data_path": path}, "data_path: expected .*found") for path in OUTSIDE.split(" ")),
        (feature(info={"is_depth_map": "some"}), r"a\.info\.is_depth_map: expected .*'some'"),
        (feature("observation.images.a/b", dtype="image"), "a camera cannot have the name"),
    ],
)
def test_broken_info_is_named(seven, write, changes, message):
    root = seven()
    write.edit_json(root / "meta/info.json", **changes)
    with refused(match=rf"source 's'.*info\.json: .*{message}.*{META_MEND}"):
        open_all(root)


@pytest.mark.parametrize(
    ("column", "cells", "message"),
    [
        ("data/file_index", None, r"data\.file_index: missing"),
        ("episode_index", [-1, 1, 2], "episode_index: expected greater .*found -1"),
        ("length", [None, 5, 9], "length: expected .*found None"),
        (f"videos/{VIEW_KEY}/from_timestamp", [np.nan, 0.7, 1.2], r"from_timestamp: expected"),
        (f"videos/{VIEW_KEY}/to_timestamp", [1e308, 0.7, 1.2], r"to_timestamp: expected"),
    ],
)
def test_rows_of_meta_of_v3_are_checked(tmp_path, write, column, cells, message):
    root = write.lerobot(tmp_path / "set", "v3.0")
    edit_v3(root, **{column: cells})
    with refused(match=rf"file-000\.parquet, row 0: .*{message}{META_MEND}"):
        open_all(root)


def test_files_of_episodes_are_all_read_and_none_is_refused(tmp_path, write):
    root = write.lerobot(tmp_path / "set", "v3.0")
    path, tasks = root / EPISODES_V3, root / "meta/tasks.parquet"
    table = pq.ParquetFile(path).read()
    pq.write_table(table.slice(0, 1), path)
    pq.write_table(table.slice(1), path.with_name("file-001.parquet"))  # as after a resumed run
    assert len(open_all(root)) == 3
    pq.write_table(pa.table({"task_index": [-1], "task": ["a"]}), tasks)
    with refused(match=rf"tasks\.parquet, row 0: task_index: expected .*found -1{META_MEND}"):
        open_all(root)
    path.unlink(), path.with_name("file-001.parquet").unlink()
    with refused(match="expected chunk-000/file-000"):
        open_all(root)


def test_whole_numbers_may_be_stored_as_floats(tmp_path, write, column="length"):
    root = write.lerobot(tmp_path / "set", "v3.0")
    cells = pq.ParquetFile(root / EPISODES_V3).read()[column]
    edit_v3(root, **{column: cells.cast(pa.float64()).to_pylist()})
    assert [len(recording.action().values) for recording in open_all(root)] == [7, 5, 9]


@pytest.mark.parametrize("version", VERSIONS[1:])
def test_what_info_says_of_an_episode_is_in_its_identity(tmp_path, write, version):
    root = write.lerobot(tmp_path / "set", version)
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    features = info["features"]
    side = {"observation.images.side": {**features[VIEW_KEY], "dtype": "image"}}

    def identity(views=("top",), **changes) -> str:
        path.write_text(json.dumps({**info, **changes}))
        return open_all(root, views)[1].identity()

    renamed = {**features, "action": {**features["action"], "names": ["x", "y", "z"]}}
    measured = {**features, "observation.state": vector(names=["a", "b"], units=["rad", "rad"])}
    retyped = {**features, "observation.state": vector(names=["a", "b"], dtype="float64")}
    identities = [
        identity(),
        identity(fps=20),
        identity(features=renamed),
        identity(features=measured),
        identity(features=retyped),
        identity(views=("top", "side"), features={**features, **side}),
    ]
    assert len(set(identities)) == len(identities)
    unread = {**dict(reversed(features.items())), **side}
    assert identities[0] == identity(total_episodes=99, features=unread)


def test_adding_an_episode_leaves_the_files_of_the_others_alone(tmp_path, write):
    small = open_all(write.lerobot(tmp_path / "a", lengths=(7, 5)))
    large = open_all(write.lerobot(tmp_path / "b", lengths=(7, 5, 9)))
    for recording, other in zip(small, large, strict=False):
        assert [p.name for p in recording.files()] == [p.name for p in other.files()]
        assert recording.identity() == other.identity()
        assert not any("meta" in path.parts for path in recording.files())


def test_tables_that_unpack_to_more_than_the_limits_are_refused_unread(tmp_path, write, seven):
    zeros = np.zeros(100_000, np.int8)
    small, unpacked = {"array_bytes": 2**16}, r"parquet: expected at most .* raise limits\.array"
    root = write.lerobot(tmp_path / "v3", "v3.0", image=True)
    names = ("episode_index", "length", "data/chunk_index", "data/file_index")
    pq.write_table(pa.table(dict.fromkeys(names, zeros)), root / EPISODES_V3)
    with refused(match=unpacked):
        open_all(root, limits=small)
    root = seven()
    table = pa.table(dict.fromkeys(("episode_index", "timestamp"), zeros))
    pq.write_table(table, root / "data/chunk-000/episode_000000.parquet")
    with refused(match=unpacked):
        open_all(root, limits=small)[0].state()
    with refused(match="100000 rows of episode 0, but meta/ says 7"):
        open_all(root)[0].state()


def test_a_column_that_stands_twice_is_named(seven):
    root = seven()
    path = root / "data/chunk-000/episode_000000.parquet"
    table = pq.ParquetFile(path).read()
    pq.write_table(table.append_column("action", table["action"]), path)
    with refused(match=r"one column 'action', found more\. Copy or write"):
        open_all(root)[0].action()


@pytest.mark.parametrize(
    ("file", "version", "make"),
    [
        ("meta/episodes.jsonl", "v2.1", os.mkfifo),
        (EPISODES_V3, "v3.0", Path.mkdir),
        ("data/chunk-000/file-000.parquet", "v3.0", Path.mkdir),
    ],
)
def test_what_is_no_file_is_named(seven, file, version, make):
    root = seven(version)
    (root / file).unlink()
    make(root / file)
    kind = "a folder" if make is Path.mkdir else "a pipe, socket or device"
    with refused(match=rf"{file}: expected a file, found {kind}"):
        open_all(root)
