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

MEND = "Copy or write the file again, or leave the episode out"
SMALL = MediaLimits(pixels=1000)


@pytest.mark.parametrize("name", ["frame_a.jpg", "zed_.jpg", "x_nan.jpg", "x_inf.jpg"])
def test_a_name_without_a_time_is_named(name):
    with pytest.raises(RecordingError, match=name):
        frame_time(Path("View1") / name)


@pytest.mark.parametrize(
    ("files", "views"),
    [
        (["View1/left/a_1.jpg", "View1/left/a_2.jpg", "View1/right/notes"], {"View1": 2}),
        (["View1/left/a_1.jpg", "View1/right/a_1.jpg"], {"View1_left": 1, "View1_right": 1}),
        (["View1_left/a_1.jpg", "View1_right/a_1.jpg"], {"View1_left": 1, "View1_right": 1}),
        (
            ["View1_left/a_1.jpg", "View10/a_1.jpg", "View2/a_1.jpg"],
            {"View1": 1, "View2": 1, "View10": 1},
        ),
        (["View1/._a_1.jpg", "View1/notes.txt", "View2/a_1.JPG"], {"View2": 1}),
        (["view1/1.0.png", "View2/2.0.bmp", "View3/Thumbs.db"], {"View2": 1, "view1": 1}),
        (["View1/1.0.jpg", ".View2/2.0.jpg"], {"View1": 1}),
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
    "names",
    [
        ("zed_41182735_left_1.0.jpg", "zed_99999_left_1.1.jpg", "zed_41182735_left_1.2.jpg"),
        ("1.0.jpg", "1.0.png"),
    ],
)
def test_frames_of_two_cameras_are_not_interleaved(names):
    with pytest.raises(RecordingError, match="expected the frames of one camera in View1"):
        JpegCamera("View1", [Path(name) for name in names])


@pytest.mark.parametrize("names", [("cam_000007.jpg",), ("zed_left_0.jpg", "zed_left_110.jpg")])
def test_numbers_of_frames_are_no_times(names):
    with pytest.raises(RecordingError, match=r"found the number of a frame.*Rename the"):
        JpegCamera("View1", [Path(name) for name in names])


@pytest.mark.parametrize("names", [("0.0.jpg", "1.0.jpg"), ("1761551500.jpg", "1761551501.jpg")])
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


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGBA"])
def test_pixels_of_a_png_are_shown_in_eight_bits(tmp_path, mode):
    made = Image.fromarray(np.full((4, 6), 200, np.uint8)).convert(mode)
    made.save(path := tmp_path / "1.0.png")
    assert check_image(path, str(path)) is None
    pixels = read_image(path, str(path))
    assert pixels.shape == (4, 6, 3)
    assert mode == "1" or 190 <= pixels.min() <= pixels.max() <= 210
    assert pixels.any()


def test_colours_keep_their_order(tmp_path):
    pixels = np.full((4, 6, 3), (200, 30, 10), np.uint8)
    Image.fromarray(pixels).save(path := tmp_path / "1.0.png")
    assert np.array_equal(read_image(path, str(path)), pixels)


def saved(format: str, kind: str = "RGB") -> bytes:
    buffer = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 255, (30, 40, 3), np.uint8)
    image = Image.fromarray(noise[:, :, 0].astype(np.uint16)) if kind == "I;16" else None
    (image or Image.fromarray(noise)).save(buffer, format)
    return buffer.getvalue()


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def large_png() -> bytes:
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + png_chunk(b"IDAT", zlib.compress(bytes(100)))


@pytest.mark.parametrize(
    ("content", "limits", "message"),
    [
        (saved("BMP"), MediaLimits(), f"expected a JPEG or PNG, found b'BM.*{MEND}"),
        (saved("JPEG")[:-400], MediaLimits(), f"cannot be decoded as an image: .*{MEND}"),
        (saved("PNG")[:900], MediaLimits(), f"cannot be decoded as an image: .*{MEND}"),
        (saved("JPEG"), SMALL, r"at most 1,000 pixels, found 1,200\. .*raise limits\.pixels"),
        (large_png(), MediaLimits(), "at most 33,177,600 pixels, found 900,000,000"),
        (saved("PNG", kind="I;16"), MediaLimits(), f"8 bits, found mode 'I;16'. {MEND}"),
    ],
)
def test_images_are_of_two_kinds_and_within_limits(tmp_path, content, limits, message):
    path = tmp_path / "a_1.5.jpg"
    path.write_bytes(content)
    for attempt in (read_image, check_image):
        with pytest.raises(RecordingError, match=rf"a_1\.5\.jpg: .*{message}"):
            attempt(path, str(path), limits)


def test_an_image_has_no_more_bytes_than_its_pixels_need(tmp_path):
    path = tmp_path / "a_1.5.jpg"
    path.write_bytes(saved("JPEG"))
    os.truncate(path, 2**34)
    camera = JpegCamera("a", [path, path])
    for attempt in (lambda: list(camera.read([0])), lambda: camera.check([0]), camera.repeats):
        with pytest.raises(RecordingError, match=r"at most 49,954,816 bytes.*limits\.pixels"):
            attempt()
