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
