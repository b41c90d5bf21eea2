"""Finding the episodes of the params' sources."""

import os
from pathlib import Path

import pytest

from pipeline.base.config import Source
from pipeline.base.errors import RecordingError
from pipeline.data import BadEpisode, content_digest, open_recordings


@pytest.fixture
def root(tmp_path: Path, write, truth) -> Path:
    """Two tasks and every format; `e10` and `e9` to see natural order."""
    write.raw(tmp_path / "raw" / "Blue_point" / "e10", truth)
    write.raw(tmp_path / "raw" / "Blue_point" / "e9", truth, views=("View1",))
    write.raw(tmp_path / "raw" / "Red_point" / "e9", truth)
    write.new(tmp_path / "new" / "Blue_point" / "episode_1", truth)
    write.old(tmp_path / "old" / "White" / "recv_all_1", truth, eyes=("left", "right"))
    write.lerobot(tmp_path / "sets" / "banana", "v3.0")
    return tmp_path


def names(root: Path, *paths: str, **entries) -> list[str]:
    path = paths[0] if len(paths) == 1 else paths
    opened = open_recordings([Source(name="s", path=path, **entries)], root)
    assert not opened.bad and not opened.missing
    return [recording.id for recording in opened.recordings]


RAW = ["Blue_point/e9", "e10", "Red_point/e9"]
SET = ["episode_000000", "episode_000001", "episode_000002"]


@pytest.mark.parametrize(
    ("paths", "ids"),
    [
        (["raw/Blue_point/e9"], ["e9"]),
        (["raw/Blue_point"], ["e9", "e10"]),
        (["raw/**/e10"], ["e10"]),
        (["raw/*/*", "raw", "raw/Blue_point/**"], RAW),
        (["sets/*", "new"], ["episode_1", *SET]),
        (["old/White/recv_all_?"], ["recv_all_1"]),
    ],
)
def test_paths_globs_and_lists_find_episodes_once_in_natural_order(root, paths, ids):
    assert names(root, *paths) == ids


def test_a_whole_tree_holds_all_formats(root):
    opened = open_recordings([Source(name="s", path=".")], root)
    assert [r.format for r in opened.recordings] == ["new", "old", *["raw"] * 3, *["lerobot"] * 3]
    assert len({r.id for r in opened.recordings}) == 8


def test_a_symbolic_link_is_the_folder_it_points_to(root):
    (root / "linked").symlink_to(root / "raw")
    (root / "raw" / "loop").symlink_to(root / "raw")
    assert names(root, "linked/**", "raw/*/e9", "raw/Blue_point/e10") == RAW


def test_ids_of_twins_take_their_parents_names(root, write):
    write.lerobot(root / "sets" / "apple", "v2.1", lengths=(3,))
    assert set(names(root, "sets")) == {
        "apple/episode_000000",
        "banana/episode_000000",
        "episode_000001",
        "episode_000002",
    }


@pytest.mark.parametrize("format", ["raw", "new", "old", "lerobot"])
def test_an_explicit_format_is_taken_or_refused(root, format):
    folder = {"lerobot": "sets"}.get(format, format)
    if format == "raw":  # a file of another format beside its own changes nothing
        (root / "raw/Red_point/e9/metadata.json").write_text("{}")
    assert names(root, folder, format=format)
    other = "new" if format != "new" else "raw"
    with pytest.raises(RecordingError, match=rf"'s'.*format '{format}', found '{other}'"):
        names(root, other, format=format)


def test_a_recording_names_its_group(root, write):
    def group():
        opened = open_recordings([Source(name="s", path="new")], root)
        if opened.bad:
            raise RecordingError(opened.bad[0].reason)
        return opened.recordings[0].group

    (path,) = (root / "new").rglob("metadata.json")
    assert group() is None
    write.edit_json(path, group="monday")
    assert group() == "monday"
    write.edit_json(path, group=["monday"])
    with pytest.raises(RecordingError, match=r"metadata\.json: group.*found \['monday'\]"):
        group()


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (("raw", "nothing/*"), r"'nothing/\*' matches nothing.*hub: owner/name in place of path"),
        ("a" * 5000, "matches nothing"),
        ("a\0b", "matches nothing"),
        ("raw/Blue_point/e9/robot_state_x.csv", "matches nothing"),
        ("raw/Blue_point/e9/View1", "none with an episode.*metadata.json.*data.pkl.*meta/info"),
    ],
)
def test_an_error_names_what_was_looked_for(root, path, message):
    with pytest.raises(RecordingError, match=f"source 's'.*{message}"):
        open_recordings([Source(name="s", path=path)], root)


def test_a_name_that_is_not_utf_8_is_refused(root):
    try:
        (root / "raw/Red_point/e9").rename(root / os.fsdecode(b"raw/Red_point/e\xff9"))
    except OSError:
        pytest.skip("this file system takes UTF-8 names alone")
    with pytest.raises(RecordingError, match=r"source 's': the name of .*/e\\udcff9' is not UTF-8"):
        open_recordings([Source(name="s", path="raw")], root)


def test_every_bad_episode_is_listed_and_the_rest_opened(root, truth, write):
    write.new(root / "new" / "Blue_point" / "episode_2", truth)
    (root / "new/Blue_point/episode_2/metadata.json").write_text("{")
    (root / "raw/Red_point/e9/robot_state_x.csv").unlink()
    opened = open_recordings([Source(name="a", path="new"), Source(name="b", path="raw")], root)
    assert len(opened.recordings) == 3
    assert [(bad.source, bad.where.name) for bad in opened.bad] == [("a", "episode_2"), ("b", "e9")]
    assert all(isinstance(bad, BadEpisode) and str(bad.where) in bad.reason for bad in opened.bad)


def test_the_view_filter_keeps_what_is_asked_for(root):
    sources = [Source(name="s", path=path) for path in ("raw", "new")]
    opened = open_recordings(sources, root, ["View1", "View5"])
    assert [list(r.cameras()) for r in opened.recordings] == [
        ["View1"],
        ["View1", "View5"],
        ["View1", "View5"],
        ["View1"],
    ]
    kept = opened.recordings[3].files()
    assert any("View1" in file.parts for file in kept)
    assert not any("View2" in file.parts for file in kept)


def test_a_view_that_nothing_has_is_refused(root):
    with pytest.raises(RecordingError, match=r"View7.*no recording has.*View1, View1_left.*top"):
        open_recordings([Source(name="s", path=".")], root, ["View1", "View7"])


def test_folders_are_searched_once_however_deep_and_often_linked(root):
    deep = root / "raw"
    for _ in range(200):
        deep /= "a"
        deep.mkdir()
        (deep.parent / "again").symlink_to(deep)
    assert len(open_recordings([Source(name="s", path="raw", format="raw")], root).recordings)


FILES = {
    "old": ("data.pkl", "View1/left/*.jpg"),
    "new": ("metadata.json", "sensor_data.npz", "robot_states.npz", "images/View1/*.jpg"),
    "raw": ("robot_state_x.csv", "sensor_data_x.npz", "View1/*.jpg"),
}


SPECIAL = [
    *((format, file, os.mkfifo, "a pipe") for format in FILES for file in FILES[format]),
    ("raw", "View1/*.jpg", Path.mkdir, "found a folder"),
    ("new", "sensor_data.npz", lambda path: path.symlink_to("nowhere"), "no such file"),
]


@pytest.mark.parametrize(("format", "file", "make", "kind"), SPECIAL)
def test_only_regular_files_are_opened(tmp_path, write, truth, only, format, file, make, kind):
    folder = getattr(write, format)(tmp_path / "T" / "e", truth)
    path = sorted(folder.glob(file))[0]
    path.unlink()
    make(path)
    if format == "old" and file != "data.pkl":
        kind = "is not there"  # the pickle names a path that is no file
    with pytest.raises((RecordingError, AssertionError), match=rf"{path.name}.*{kind}"):
        recording = only(folder)
        recording.state(), recording.sensor(), recording.instruction
        for camera in recording.cameras().values():
            camera.check(range(len(camera.time)))
    if file != "metadata.json":
        with pytest.raises(RecordingError, match=rf"{path.name}.*{kind}"):
            content_digest(only(folder), str)
