"""What files of recordings may not be, and may not ask for."""

import io
import os
import struct
import tracemalloc
import warnings
import zipfile
import zlib
from fractions import Fraction
from functools import partial
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image
from pipeline.data.media import check_unpacked, opened_video

from pipeline.base.config import MediaLimits
from pipeline.base.errors import RecordingError
from pipeline.data.arrays import read_csv, read_npy, read_npz
from pipeline.data.jpeg import JpegCamera, check_image, read_image
from pipeline.data.recording import content_digest

MEND = "Copy the file again, or leave the episode out"
ASKED = (read_image, check_image)
SMALL = MediaLimits(pixels=1000, array_bytes=2**20, ratio=1)

SPECIAL = {
    "pipe": (os.mkfifo, "a pipe, socket or device"),
    "device": (lambda path: path.symlink_to("/dev/zero"), "a pipe, socket or device"),
    "folder": (Path.mkdir, "found a folder"),
    "link to nothing": (lambda path: path.symlink_to("nowhere"), "no such file"),
    "link to itself": (lambda path: path.symlink_to(path), "cannot be read"),
}
FILES = {
    "old": ("data.pkl", "View1/left/*.jpg"),
    "new": ("metadata.json", "sensor_data.npz", "robot_states.npz", "images/View1/*.jpg"),
    "raw": ("robot_state_x.csv", "sensor_data_x.npz", "View1/*.jpg"),
}


@pytest.mark.parametrize("kind", SPECIAL)
@pytest.mark.parametrize(
    ("format", "file"), [(format, file) for format, files in FILES.items() for file in files]
)
def test_only_regular_files_are_opened(tmp_path, write, truth, only, format, file, kind):
    folder = getattr(write, format)(tmp_path / "T" / "e", truth)
    path = sorted(folder.glob(file))[0]
    path.unlink()
    make, found = SPECIAL[kind]
    make(path)
    if format == "old" and file != "data.pkl":
        found = "is not there"  # a path in the pickle to what is no file
    with pytest.raises((RecordingError, AssertionError), match=rf"{path.name}.*{found}"):
        recording = only(folder)
        recording.state(), recording.sensor(), recording.instruction
        for camera in recording.cameras().values():
            camera.check(range(len(camera.time)))
    if file != "metadata.json":
        with pytest.raises(RecordingError, match=rf"{path.name}.*{found}"):
            content_digest(only(folder), str)


def saved(format: str, size: tuple[int, int] = (40, 30), kind: str = "RGB", **options) -> bytes:
    buffer = io.BytesIO()
    Image.new(kind, size).save(buffer, format, **options)
    return buffer.getvalue()


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def large_png() -> bytes:
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + png_chunk(b"IDAT", zlib.compress(bytes(100)))


def many_chunks() -> bytes:
    content = saved("PNG")
    return content[:33] + png_chunk(b"tEXt", b"") * 100_000 + content[33:]


def many_scans() -> bytes:
    content = saved("JPEG", progressive=True)
    last = content.rfind(b"\xff\xda")
    return content[:last] + content[last:-2] * 101 + b"\xff\xd9"


def many_plain_scans(before: bytes = b"", kind: str = "RGB") -> bytes:
    """A JPEG that is not progressive, and has one colour a scan."""
    content = saved("JPEG", kind=kind)
    scans = b"".join(b"\xff\xda\0\x08\x01%c\0\0\x3f\0\0" % color for color in (1, 2, 3))
    return content[: content.rfind(b"\xff\xda")] + before + scans * 34 + b"\xff\xd9"


@pytest.mark.parametrize(
    ("content", "limits", "message"),
    [
        *(
            (saved(kind), MediaLimits(), f"expected a JPEG or PNG, found b'{start}.*{MEND}")
            for kind, start in (("BMP", "BM"), ("TIFF", "II"), ("GIF", "GIF8"), ("WEBP", "RIFF"))
        ),
        (b"8BPS" + bytes(40), MediaLimits(), "expected a JPEG or PNG, found b'8BPS"),
        (b"", MediaLimits(), f"expected a JPEG or PNG, found b''.*{MEND}"),
        (saved("JPEG")[:30], MediaLimits(), f"cannot be decoded as an image: .*{MEND}"),
        (saved("JPEG"), SMALL, r"at most 1,000 pixels, found 1,200\. .*raise limits\.pixels"),
        (saved("PNG"), SMALL, r"at most 1,000 pixels, found 1,200\. .*raise limits\.pixels"),
        (many_chunks(), MediaLimits(), "at most 100,000 chunks.*Write the file"),
        (large_png(), MediaLimits(), "at most 33,177,600 pixels, found 900,000,000"),
        *(
            (content, MediaLimits(), "at most 100 scans over the image, found 1.*Write the file")
            for content in (
                many_scans(),
                many_plain_scans(),
                many_plain_scans(b"\xff\xfe\0\x10" + b"\xff\xda\0\x0e\x04" * 3),
                many_plain_scans(b"\xff\xfe\0\x08\xff\xda\0\x0e\x04\0", kind="CMYK"),
            )
        ),
    ],
)
def test_images_are_of_two_kinds_and_within_limits(tmp_path, content, limits, message):
    path = tmp_path / "a_1.5.jpg"
    path.write_bytes(content)
    for attempt in ASKED:
        with pytest.raises(RecordingError, match=rf"a_1\.5\.jpg: .*{message}"):
            attempt(path, str(path), limits)


def test_an_image_has_no_more_bytes_than_its_pixels_need(tmp_path):
    path = tmp_path / "a_1.5.jpg"
    path.write_bytes(saved("JPEG"))
    os.truncate(path, 2**34)
    camera = JpegCamera("a", [path, path])
    for attempt in (*(partial(ask, path, str(path)) for ask in ASKED), camera.repeats):
        with pytest.raises(RecordingError, match=r"at most 49,954,816 bytes.*limits\.pixels"):
            attempt()


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"kind": "L"}, {"kind": "CMYK"}])
def test_an_image_is_read_whole_only_for_its_scans(tmp_path, options):
    path = tmp_path / "a_1.5.jpg"
    path.write_bytes(saved("JPEG", **options))
    os.truncate(path, 40_000_000)
    for ask in ASKED:
        tracemalloc.start()
        ask(path, str(path))
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert (most > 40_000_000) == ("progressive" in options)


def mjpeg(path: Path, *sizes: int) -> Path:
    """A video whose frames are squares of these sizes."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=10)
        stream.width = stream.height = sizes[0]
        stream.pix_fmt = "yuvj420p"
        for number, size in enumerate(sizes):
            packet = av.Packet(saved("JPEG", (size, size)))
            packet.pts = packet.dts = number
            packet.time_base, packet.stream, packet.is_keyframe = Fraction(1, 10), stream, True
            container.mux(packet)
    return path


def playlist(path: Path) -> Path:
    mjpeg(path.with_name("neighbour.mp4"), 16)
    path.write_text("ffconcat version 1.0\nfile neighbour.mp4\n")
    return path


def gif(path: Path) -> Path:
    path.write_bytes(saved("GIF"))
    return path


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (playlist, r"cannot be read as video \(MP4, Matroska, WebM or AVI\).*" + MEND),
        (gif, r"cannot be read as video \(MP4"),
        (lambda path: mjpeg(path, 40), r"at most 1,000 pixels, found 1,600\. .*limits\.pixels"),
        (lambda path: mjpeg(path, 16, 40), f"cannot be read as video.*{MEND}"),
    ],
)
def test_videos_are_of_few_kinds_and_within_limits(tmp_path, make, message):
    path = make(tmp_path / "a.mp4")
    with (
        pytest.raises(RecordingError, match=rf"a\.mp4: .*{message}"),
        opened_video(path, SMALL) as (container, stream),
    ):
        list(container.decode(stream))


def npy(shape: str, body: bytes = b"", dtype: str = "<f8", version: bytes = b"\1\0") -> bytes:
    header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}}}\n".encode()
    return b"\x93NUMPY" + version + struct.pack("<H", len(header)) + header + body


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (npy("(1000000000000,)"), r"\(1000000000000,\) of float64 is not what its 0 bytes hold"),
        (npy("(-1,)", bytes(8)), "is not what its 8 bytes hold"),
        (npy("(True,)", bytes(8)), "is not what its 8 bytes hold"),
        (npy("(1,)", bytes(16)), "is not what its 16 bytes hold"),
        (npy("(1,)", bytes(8), "|V8"), "expected an array of numbers, found void"),
        (npy("(1,)", bytes(8), "|O"), "expected an array of numbers, found object"),
        (npy("(1,)", bytes(8), version=b"\x09\0"), "its header is damaged or not numpy's"),
        (npy("(" * 5000), "its header is damaged or not numpy's"),
        (b"\x93NUMPY\x02\x00\xff\xff\xff\xff{", "its header is damaged or not numpy's"),
        (npy("(200000,)", bytes(1_600_000)), "at most 1,048,576 bytes unpacked.* Leave the"),
        (npy("(2147483648, 0)"), r"expected rows with values, found \(2147483648, 0\) of float64"),
        (npy("(2147483648,)", dtype="<U0"), r"expected rows with values, found \(2147483648,\)"),
    ],
)
def test_arrays_are_what_their_bytes_hold(tmp_path, content, message):
    path, packed = tmp_path / "a.npy", tmp_path / "a.npz"
    path.write_bytes(content)
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(path, "values.npy")
    for attempt, place in (
        (lambda: read_npy(path, SMALL), "a.npy"),
        (lambda: read_npz(packed, ["values"], limits=SMALL), "a.npz, member 'values'"),
    ):
        with pytest.raises(RecordingError, match=rf"{place}: .*{message}.*episode out") as caught:
            attempt()
        assert "pickle" not in str(caught.value)


def test_an_array_may_have_no_rows_and_lists_of_words_end(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, values=np.zeros((0, 7)), names=np.zeros(65_537, "<U1"))
    assert read_npz(path, ["values"])["values"].shape == (0, 7)
    message = r"'names': expected a list of at most 65,536 words, found <U1 of shape \(65537,\)"
    with pytest.raises(RecordingError, match=message):
        read_npz(path, ["values"], text=["names"])


def test_what_unpacks_a_hundredfold_is_refused_unread():
    check_unpacked("a", 256 * 2**20, 1, MediaLimits())
    with pytest.raises(RecordingError, match=r"a: .*found 300,000,000\. .*raise limits\.ratio"):
        check_unpacked("a", 300_000_000, 2_000_000, MediaLimits())


@pytest.mark.parametrize(
    ("at", "value", "message"), [(8, 1, "encrypted"), (10, 99, "method"), (16, 1, "CRC")]
)
def test_a_spoilt_archive_is_named(tmp_path, at, value, message):
    path = tmp_path / "a.npz"
    np.savez(path, values=np.zeros(9999))
    content = bytearray(path.read_bytes())
    struct.pack_into("<H", content, content.find(b"PK\1\2") + at, value)
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=rf"a\.npz, member 'values': .*{message}.*{MEND}"):
        read_npz(path, ["values"])


def test_a_member_stands_once(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, values=np.zeros(3))
    with warnings.catch_warnings(), zipfile.ZipFile(path, "a") as archive:
        warnings.simplefilter("ignore")
        archive.writestr("values.npy", npy("(0,)"))
    with pytest.raises(RecordingError, match=rf"'values': expected once, found twice. {MEND}"):
        read_npz(path, ["values"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n1_0,2\n", r"line 3, column 'a': '1_0' is not a number"),
        ("a,b\n1,١٢\n", r"line 2, column 'b': '١٢' is not a number"),
        ("a,b\n1,0x10\n", r"line 2, column 'b': '0x10' is not a number"),
        ("a,b\n1,2\0\n", r"line 2, column 'b': '2\\x00' is not a number"),
        ("a,b,a\n1,2,3\n", r"twice the column\(s\) a; it has a, b, a"),
        (",".join(f"c{n}" for n in range(10_001)), "at most 10,000 columns, found 10,001"),
        ("a,b\n1," + "2" * 2**20 + "\n", "line 2: expected lines of fewer than 1,048,576"),
        ('a,b\n1,"' + "2" * 200_000 + '"\n', f"cannot be read as CSV: Error: field larger.*{MEND}"),
    ],
)
def test_a_table_is_bounded_and_holds_plain_numbers(tmp_path, text, message):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(RecordingError, match=rf"a\.csv.*{message}"):
        read_csv(path, ["a", "b"])


@pytest.mark.parametrize(
    ("time", "message"),
    [([0.0, 1e308], r"x: timestamp 1e\+308 in row 1"), ([np.nan], "x: timestamp nan in row 0")],
)
def test_no_clock_is_farther_than_any(time, message):
    from pipeline.data.recording import check_clock

    with pytest.raises(RecordingError, match=message):
        check_clock(np.array(time), "x")
