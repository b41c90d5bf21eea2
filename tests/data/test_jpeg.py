"""Folders of JPEGs."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.base.errors import RecordingError
from pipeline.data.jpeg import (
    JpegCamera,
    check_image,
    frame_time,
    list_views,
    read_image,
)


@pytest.mark.parametrize(
    ("name", "time"),
    [
        ("zed_41182735_left_1761551500.174.jpg", 1761551500.174),
        ("1762581333.076.jpg", 1762581333.076),
        ("oak_1944301011169A4800_12.jpeg", 12.0),
    ],
)
def test_the_time_is_the_last_part_of_the_stem(name: str, time: float):
    assert frame_time(Path(name)) == time


@pytest.mark.parametrize("name", ["frame_a.jpg", "zed_.jpg", "x_nan.jpg", "x_inf.jpg"])
def test_a_name_without_a_time_is_named(name: str):
    with pytest.raises(RecordingError, match=name):
        frame_time(Path("View1") / name)


@pytest.mark.parametrize(
    ("files", "views"),
    [
        (["View1/a_1.jpg"], {"View1": 1}),
        (["View1/left/a_1.jpg", "View1/left/a_2.jpg"], {"View1": 2}),
        (["View1/left/a_1.jpg", "View1/right/a_1.jpg"], {"View1_left": 1, "View1_right": 1}),
        (["View1/z_left_1.jpg", "View1/z_right_1.jpg"], {"View1_left": 1, "View1_right": 1}),
        (["View1/z_right_1.jpg"], {"View1": 1}),
        (["View1_left/a_1.jpg", "View1_right/a_1.jpg"], {"View1_left": 1, "View1_right": 1}),
        (
            ["View1_left/a_1.jpg", "View10/a_1.jpg", "View2/a_1.jpg"],
            {"View1": 1, "View2": 1, "View10": 1},
        ),
        (["View1/._a_1.jpg", "View1/notes.txt", "View2/a_1.JPG"], {"View2": 1}),
    ],
)
def test_views_are_named_by_folder_and_eye(tmp_path: Path, files, views):
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    found = list_views(tmp_path, prefix="View")
    assert {view: len(paths) for view, paths in found.items()} == views
    assert list(found) == list(views)


def test_an_empty_eye_does_not_count(tmp_path: Path):
    (tmp_path / "View1/left").mkdir(parents=True)
    (tmp_path / "View1/right").mkdir(parents=True)
    (tmp_path / "View1/left/a_1.jpg").touch()
    assert list(list_views(tmp_path)) == ["View1"]


def test_frames_are_sorted_by_time_and_decoded_once_a_repeat(tmp_path: Path, write):
    paths = [write.jpeg(tmp_path / f"a_{t}.jpg", shade) for t, shade in ((10.5, 9), (9.5, 200))]
    camera = JpegCamera("View1", paths)
    assert camera.time.tolist() == [9.5, 10.5]
    first, again, second = camera.read([0, 0, 1])
    assert first is again
    assert abs(int(first[-1, -1, 0]) - 200) < 3 and abs(int(second[-1, -1, 0]) - 9) < 3


@pytest.mark.parametrize("mode", ["L", "CMYK", "RGB"])
def test_every_mode_becomes_rgb_and_exif_is_ignored(tmp_path: Path, mode: str):
    image = Image.fromarray(np.full((10, 20, 3), 128, np.uint8)).convert(mode)
    exif = Image.Exif()
    exif[0x0112] = 6  # rotate by 90 degrees
    image.save(tmp_path / "a_1.jpg", exif=exif)
    assert read_image(tmp_path / "a_1.jpg", "x").shape == (10, 20, 3)


@pytest.mark.parametrize("damage", ["truncated", "empty", "text"])
@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_an_unreadable_image_is_found_by_check_and_by_read(tmp_path: Path, damage, suffix):
    path = tmp_path / f"a_1.{suffix}"
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    Image.fromarray(noise).save(path)
    whole = path.read_bytes()
    path.write_bytes(
        {"truncated": whole[: len(whole) // 2], "empty": b"", "text": b"not an image"}[damage]
    )
    for attempt in (check_image, read_image):
        with pytest.raises(RecordingError, match=f"a_1.{suffix}"):
            attempt(path, str(path))


@pytest.mark.parametrize(
    "names",
    [
        ("000001.jpg", "000002.jpg"),
        ("cam_000007.jpg",),
        ("0.jpg", "1.jpg", "2.jpg"),
        tuple(f"zed_left_{number}.jpg" for number in range(1, 12)),
    ],
)
def test_numbers_of_frames_are_no_times(names):
    with pytest.raises(RecordingError, match=r"ends in the time in seconds.*Rename the frames"):
        JpegCamera("View1", [Path(name) for name in names])


def test_times_in_whole_seconds_are_no_numbers_of_frames():
    names = [("0.jpg",), ("0.0.jpg", "1.0.jpg"), ("1761551500.jpg", "1761551501.jpg")]
    for some in names:
        camera = JpegCamera("View1", [Path(name) for name in some])
        assert camera.time.tolist() == [float(Path(name).stem) for name in some]


@pytest.mark.parametrize(
    "names",
    [
        ("zed_41182735_left_1.0.jpg", "zed_99999_left_1.1.jpg", "zed_41182735_left_1.2.jpg"),
        ("1.0.jpg", "1.0.png"),
    ],
)
def test_frames_of_two_cameras_are_not_interleaved(names):
    with pytest.raises(RecordingError, match="expected the frames of one camera in View1"):
        JpegCamera("View1", [Path(name) for name in names])


@pytest.mark.parametrize("name", ["zed_2_left_1.1.jpg", "right/1.0.jpg"])
def test_frames_with_an_eye_are_of_another_camera_than_those_without(tmp_path, write, name):
    for file in ("1.0.jpg", name):
        write.jpeg(tmp_path / "View1" / file)
    with pytest.raises(RecordingError, match="expected the frames of one camera in View1"):
        list_views(tmp_path)


def test_any_image_is_a_frame_and_view_names_differ_by_more_than_case(tmp_path):
    for name in ("view1/1.0.png", "View2/2.0.bmp", "View3/Thumbs.db"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    assert [*list_views(tmp_path, prefix="View")] == ["View1", "View2"]
    (tmp_path / "View1").mkdir()
    with pytest.raises(RecordingError, match="expected one folder of this view"):
        list_views(tmp_path, prefix="View")


MODES = ("1", "L", "LA", "P", "RGB", "RGBA", "I;16")


@pytest.mark.parametrize("mode", MODES)
def test_pixels_of_a_png_are_shown_in_eight_bits(tmp_path, mode):
    grey = np.full((4, 6), 200 * 256 + 9 if mode == "I;16" else 200)
    made = Image.fromarray(grey.astype(np.uint16 if mode == "I;16" else np.uint8))
    made.convert(mode).save(path := tmp_path / "1.0.png")
    check_image(path, str(path))
    pixels = read_image(path, str(path))
    assert pixels.shape == (4, 6, 3)
    assert mode == "1" or 190 <= pixels.min() <= pixels.max() <= 210
    assert pixels.any()


def test_a_mode_that_cannot_be_shown_is_refused_by_name(tmp_path, monkeypatch):
    Image.fromarray(np.zeros((4, 6), np.uint8)).save(path := tmp_path / "1.0.png")
    monkeypatch.setattr("pipeline.data.jpeg._AS_RGB", ("RGB",))
    for look in (check_image, read_image):
        with pytest.raises(RecordingError, match="found mode 'L'"):
            look(path, str(path))


@pytest.mark.parametrize("counts", [(0, 1, 2, 4, 5), (2, 3, 4), (100, 101, 110)])
def test_frames_counted_with_a_gap_or_from_any_number_are_refused(tmp_path, counts):
    (tmp_path / "View1").mkdir()
    paths = [tmp_path / "View1" / f"zed_left_{count}.jpg" for count in counts]
    with pytest.raises(RecordingError, match=f"frames counted from {counts[0]} to {counts[-1]}"):
        JpegCamera("View1", paths)
    seconds = [tmp_path / f"zed_left_{1761551500 + count}.jpg" for count in counts]
    assert len(JpegCamera("View1", seconds).time) == len(counts)
