"""Images, and folders of them as views."""

import io
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.base.config import MediaLimits
from pipeline.base.errors import RecordingError
from pipeline.data.jpeg import JpegCamera, check_image, frame_time, list_views, read_image

MEND = "Copy the file again, or leave the episode out"
SMALL = MediaLimits(pixels=1000)


@pytest.mark.parametrize(
    ("name", "time"),
    [
        ("zed_41182735_left_1761551500.174.jpg", 1761551500.174),
        ("1762581333.076.jpg", 1762581333.076),
        ("oak_1944301011169A4800_12.jpeg", 12.0),
    ],
)
def test_the_time_is_the_last_part_of_the_stem(name, time):
    assert frame_time(Path(name)) == time


@pytest.mark.parametrize("name", ["frame_a.jpg", "zed_.jpg", "x_nan.jpg", "x_inf.jpg"])
def test_a_name_without_a_time_is_named(name):
    with pytest.raises(RecordingError, match=name):
        frame_time(Path("View1") / name)


@pytest.mark.parametrize(
    ("files", "views"),
    [
        (["View1/left/a_1.jpg", "View1/left/a_2.jpg", "View1/right/notes"], {"View1": 2}),
        (["View1/left/a_1.jpg", "View1/right/a_1.jpg"], {"View1_left": 1, "View1_right": 1}),
        (["View1/z_left_1.jpg", "View1/z_right_1.jpg"], {"View1_left": 1, "View1_right": 1}),
        (["View1/z_right_1.jpg"], {"View1": 1}),
        (["View1_left/a_1.jpg", "View1_right/a_1.jpg"], {"View1_left": 1, "View1_right": 1}),
        (
            ["View1_left/a_1.jpg", "View10/a_1.jpg", "View2/a_1.jpg"],
            {"View1": 1, "View2": 1, "View10": 1},
        ),
        (["View1/._a_1.jpg", "View1/notes.txt", "View2/a_1.JPG"], {"View2": 1}),
        (["view1/1.0.png", "View2/2.0.bmp", "View3/Thumbs.db"], {"View1": 1, "View2": 1}),
    ],
)
def test_views_are_named_by_folder_and_eye(tmp_path, files, views):
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    listed = list_views(tmp_path, prefix="View")
    assert {view: len(paths) for view, paths in listed.items()} == views
    assert list(listed) == list(views)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (("View1/1.0.jpg", "View1/zed_2_left_1.1.jpg"), "frames of one camera in View1"),
        (("View1/1.0.jpg", "View1/right/1.0.jpg"), "frames of one camera in View1"),
        (("View1/1.0.jpg", "view1/1.0.jpg"), "one folder of this view"),
    ],
)
def test_folders_that_mix_cameras_are_refused(tmp_path, files, message):
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    with pytest.raises(RecordingError, match=f"expected .*{message}"):
        list_views(tmp_path, prefix="View")


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


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("cam_000007.jpg",), "000007"),
        (("0.jpg", "1.jpg", "2.jpg"), "counted from 0 to 2"),
        (("zed_left_100.jpg", "zed_left_101.jpg", "zed_left_110.jpg"), "counted from 100 to 110"),
    ],
)
def test_numbers_of_frames_are_no_times(names, message):
    match = rf"ends in the time in seconds.*{message}.*Rename the frames"
    with pytest.raises(RecordingError, match=match):
        JpegCamera("View1", [Path(name) for name in names])


@pytest.mark.parametrize(
    "names", [("0.jpg",), ("0.0.jpg", "1.0.jpg"), ("1761551500.jpg", "1761551501.jpg")]
)
def test_times_in_whole_seconds_are_no_numbers_of_frames(names):
    camera = JpegCamera("View1", [Path(name) for name in names])
    assert camera.time.tolist() == [float(Path(name).stem) for name in names]


def test_frames_are_sorted_by_time_and_decoded_once_a_repeat(tmp_path, write):
    paths = [write.jpeg(tmp_path / f"a_{t}.jpg", shade) for t, shade in ((10.5, 9), (9.5, 200))]
    camera = JpegCamera("View1", paths)
    assert camera.time.tolist() == [9.5, 10.5] and camera.repeats().tolist() == [False]
    first, again, second = camera.read([0, 0, 1])
    assert first is again
    assert abs(int(first[-1, -1, 0]) - 200) < 3 and abs(int(second[-1, -1, 0]) - 9) < 3
    thumbnails = camera.check([0, 1])
    assert thumbnails.shape == (2, 18, 32, 3)
    assert abs(int(thumbnails[0, -1, -1, 0]) - 200) < 9 > abs(int(thumbnails[1, -1, -1, 0]) - 9)
    write.jpeg(paths[0], 200)
    assert camera.repeats().tolist() == [True]


@pytest.mark.parametrize("mode", ["L", "CMYK", "RGB"])
def test_every_mode_becomes_rgb_and_exif_is_ignored(tmp_path, mode):
    image = Image.fromarray(np.full((10, 20, 3), 128, np.uint8)).convert(mode)
    exif = Image.Exif()
    exif[0x0112] = 6  # rotate by 90 degrees
    image.save(tmp_path / "a_1.jpg", exif=exif)
    assert read_image(tmp_path / "a_1.jpg", "x").shape == (10, 20, 3)


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGBA", "I;16"])
def test_pixels_of_a_png_are_shown_in_eight_bits(tmp_path, mode):
    grey = np.full((4, 6), 200 * 256 + 9 if mode == "I;16" else 200)
    made = Image.fromarray(grey.astype(np.uint16 if mode == "I;16" else np.uint8))
    made.convert(mode).save(path := tmp_path / "1.0.png")
    assert check_image(path, str(path)) is None
    pixels = read_image(path, str(path))
    assert pixels.shape == (4, 6, 3)
    assert mode == "1" or 190 <= pixels.min() <= pixels.max() <= 210
    assert pixels.any()


def saved(format: str, size: tuple[int, int] = (40, 30), kind: str = "RGB", **options) -> bytes:
    buffer = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3), np.uint8)
    Image.fromarray(noise).convert(kind).save(buffer, format, **options)
    return buffer.getvalue()


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def large_png() -> bytes:
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + png_chunk(b"IDAT", zlib.compress(bytes(100)))


def many_scans() -> bytes:
    content = saved("JPEG", progressive=True)
    last = content.rfind(b"\xff\xda")
    return content[:last] + content[last:-2] * 101 + b"\xff\xd9"


def many_plain_scans() -> bytes:
    """A JPEG that is not progressive, and has one colour a scan."""
    content = saved("JPEG")
    scans = b"".join(b"\xff\xda\0\x08\x01%c\0\0\x3f\0\0" % color for color in (1, 2, 3))
    return content[: content.rfind(b"\xff\xda")] + scans * 34 + b"\xff\xd9"


@pytest.mark.parametrize(
    ("content", "limits", "message"),
    [
        (saved("BMP"), MediaLimits(), f"expected a JPEG or PNG, found b'BM.*{MEND}"),
        (saved("GIF"), MediaLimits(), f"expected a JPEG or PNG, found b'GIF8.*{MEND}"),
        (b"", MediaLimits(), f"expected a JPEG or PNG, found b''.*{MEND}"),
        (saved("JPEG")[:-400], MediaLimits(), f"cannot be decoded as an image: .*{MEND}"),
        (saved("PNG")[:900], MediaLimits(), f"cannot be decoded as an image: .*{MEND}"),
        (saved("JPEG"), SMALL, r"at most 1,000 pixels, found 1,200\. .*raise limits\.pixels"),
        (large_png(), MediaLimits(), "at most 33,177,600 pixels, found 900,000,000"),
        (many_scans(), MediaLimits(), "at most 100 scans over the image, found 1.*Write the file"),
        (many_plain_scans(), MediaLimits(), "at most 100 scans over the image, found 102"),
    ],
)
def test_images_are_of_two_kinds_and_within_limits(tmp_path, content, limits, message):
    path = tmp_path / "a_1.5.jpg"
    path.write_bytes(content)
    for attempt in (read_image, check_image):
        with pytest.raises(RecordingError, match=rf"a_1\.5\.jpg: .*{message}"):
            attempt(path, str(path), limits)


def test_a_mode_that_cannot_be_shown_is_refused_by_name(tmp_path, monkeypatch):
    Image.fromarray(np.zeros((4, 6), np.uint8)).save(path := tmp_path / "1.0.png")
    monkeypatch.setattr("pipeline.data.jpeg._AS_RGB", ("RGB",))
    for attempt in (check_image, read_image):
        with pytest.raises(RecordingError, match="found mode 'L'"):
            attempt(path, str(path))


def test_an_image_has_no_more_bytes_than_its_pixels_need(tmp_path):
    path = tmp_path / "a_1.5.jpg"
    path.write_bytes(saved("JPEG"))
    os.truncate(path, 2**34)
    camera = JpegCamera("a", [path, path])
    for attempt in (lambda: list(camera.read([0])), lambda: camera.check([0]), camera.repeats):
        with pytest.raises(RecordingError, match=r"at most 49,954,816 bytes.*limits\.pixels"):
            attempt()
