"""Frames by number, from whole files and from parts of shared ones; which videos are refused."""

from fractions import Fraction
from io import BytesIO
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from pipeline.base.config import MediaLimits, Source
from pipeline.base.errors import RecordingError
from pipeline.data import open_recordings
from pipeline.data.lerobot_writer import LeRobotRows, write_data_set
from pipeline.data.video import VideoClip, VideoSpan, opened_video

ENCODINGS = [
    *(("libx264", group, 0) for group in (1, 4, 40)),
    *((codec, 4, 0) for codec in ("mpeg4", "libsvtav1")),
    # Frames shown in another order than they are decoded in, across key frames too.
    *((codec, 5, 2) for codec in ("libx264", "mpeg4")),
]
SHADES = [20 + 11 * (frame % 18) for frame in range(36)]


def clip(path, rows: int, first: int | None = None, count: int | None = None) -> VideoClip:
    return VideoClip("top", np.arange(rows) / 10, VideoSpan(path, first, count), 10.0)


def shades(frames) -> list[int]:
    """The shade of the plain corner of each frame, to the nearest of the writer's."""
    return [round((int(frame[-4, -4].mean()) - 20) / 11) for frame in frames]


def needs(codec: str) -> None:
    if codec not in av.codecs_available:
        pytest.skip(f"this PyAV build has no {codec}")


@pytest.fixture(params=ENCODINGS, ids=lambda encoding: "-".join(map(str, encoding)))
def path(request, tmp_path, write):
    codec, group, b_frames = request.param
    needs(codec)
    return write.video(tmp_path / "a.mp4", SHADES, 10, codec, group, b_frames)


def test_frames_of_a_whole_file(path):
    for indices in (range(36), range(0, 36, 3), [0], [35], [7, 7, 8], [1, 30, 31, 35, 35], []):
        camera = clip(path, 36)
        camera.check(indices)
        assert shades(camera.read(indices)) == [index % 18 for index in indices]


def test_part_of_a_shared_file(path):
    for first, rows in ((0, 12), (12, 11), (23, 13), (5, 1), (35, 1)):
        camera = clip(path, rows, first, rows)
        assert shades(camera.read(range(rows))) == [(first + row) % 18 for row in range(rows)]
        assert shades(camera.read([rows - 1])) == [(first + rows - 1) % 18]
    whole = list(clip(path, 36).read(range(36)))
    part = clip(path, 10, 20, 10).read(range(10))
    assert all(np.array_equal(a, b) for a, b in zip(whole[20:30], part, strict=True))


@pytest.mark.parametrize(
    ("rows", "first", "count", "message"),
    [
        (35, None, None, "36 frames of view 'top' but 35 rows"),
        (10, 30, 10, "6 frames of view 'top' but 10 rows"),
        (10, 0, 11, "11 frames of view 'top' but 10 rows"),
        (10, 90, 10, "0 frames of view 'top' but 10 rows"),
    ],
)
def test_counts_that_disagree_are_both_named(tmp_path, write, rows, first, count, message):
    path = write.video(tmp_path / "a.mp4", [50] * 36)
    for attempt in (lambda c: list(c.read([0])), lambda c: c.check([])):
        with pytest.raises(RecordingError, match=rf"a\.mp4: {message}"):
            attempt(clip(path, rows, first, count))


def test_a_file_cut_off_behind_its_index_is_found_by_check(tmp_path, write):
    slow = write.video(tmp_path / "slow.mp4", SHADES)
    path = tmp_path / "a.mp4"
    with (
        av.open(str(slow)) as source,
        av.open(str(path), "w", options={"movflags": "faststart"}) as target,
    ):
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.size:
                packet.stream = stream
                target.mux(packet)
    assert clip(path, 36).check([0]) is None
    whole = path.read_bytes()
    path.write_bytes(whole[: -len(whole) // 8])
    with pytest.raises(RecordingError, match=r"a\.mp4"):
        clip(path, 36).check([0])


def damage(path, packet: int, kept: float = 0.0) -> None:
    """Zeros over a packet, behind the part of it that is kept."""
    with av.open(str(path)) as container:
        packets = [(p.pos, p.size) for p in container.demux(video=0) if p.size]
    content, (begin, size) = bytearray(path.read_bytes()), packets[packet]
    begin, stop = begin + round(kept * size), begin + size
    content[begin:stop] = bytes(stop - begin)
    path.write_bytes(bytes(content))


@pytest.mark.parametrize("codec", ["libx264", "libsvtav1"])
def test_damage_inside_a_packet_is_found_and_named(tmp_path, write, codec):
    needs(codec)
    path = write.video(tmp_path / "a.mp4", SHADES, codec=codec, group=1)
    damage(path, 20)
    assert len(list(clip(path, 36).read(range(18)))) == 18
    assert len(list(clip(path, 36).read([19, 21]))) == 2
    clip(path, 36).check([19, 21])
    for attempt in (lambda c: list(c.read([20])), lambda c: c.check([0, 20, 35])):
        with pytest.raises(RecordingError, match=r"a\.mp4: frame 20 of view 'top' cannot be dec"):
            attempt(clip(path, 36))


@pytest.mark.parametrize("packet", [13, 14])
def test_damage_that_the_decoder_conceals_spoils_the_frames_after_it(tmp_path, write, packet):
    path = write.video(tmp_path / "a.mp4", list(range(0, 216, 6)))
    damage(path, packet, kept=0.5)
    clip(path, 36).check([0, 12, 16, 35])
    for attempt in (lambda c: list(c.read([12, 15])), lambda c: c.check([12, 15])):
        with pytest.raises(RecordingError, match=r"a\.mp4: frame 15 of view 'top' cannot be dec"):
            attempt(clip(path, 36))


def sound(path: Path) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.rate = 44100
        container.mux([*stream.encode(frame), *stream.encode()])


def mjpeg(path: Path, *sizes: int) -> None:
    """A video whose frames are squares of these sizes."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=10)
        stream.width = stream.height = sizes[0]
        stream.pix_fmt = "yuvj420p"
        for number, size in enumerate(sizes):
            Image.new("RGB", (size, size)).save(buffer := BytesIO(), "JPEG")
            packet = av.Packet(buffer.getvalue())
            packet.pts = packet.dts = number
            packet.time_base, packet.stream, packet.is_keyframe = Fraction(1, 10), stream, True
            container.mux(packet)


def playlist(path: Path) -> None:
    mjpeg(path.with_name("neighbour.mp4"), 16)
    path.write_text("ffconcat version 1.0\nfile neighbour.mp4\n")


NONE = r"cannot be read as video \(MP4, Matroska, WebM or AVI\): Invalid \w+.*Copy or write"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (playlist, NONE),
        (sound, "holds no video"),
        (
            lambda path: mjpeg(path, 40),
            r"expected at most 1,000 pixels, found 1,600\. .*limits\.pixels",
        ),
        (lambda path: mjpeg(path, 16, 40), "cannot be read as video.*Copy or write the file again"),
    ],
)
def test_videos_are_of_few_kinds_and_within_limits(tmp_path, make, message):
    path = tmp_path / "a.mp4"
    make(path)
    with (
        pytest.raises(RecordingError, match=rf"a\.mp4: {message}") as refused,
        opened_video(path, MediaLimits(pixels=1000)) as (container, stream),
    ):
        list(container.decode(stream))
    text = str(refused.value)
    assert text.count(str(path)) == 1 and "Errno" not in text


def test_frames_of_one_time_are_refused(tmp_path, write):
    path = write.video(tmp_path / "a.mkv", SHADES, 3000)  # Matroska counts milliseconds
    with pytest.raises(RecordingError, match=r"a\.mkv: frames \d and \d of view 'top' have the sa"):
        clip(path, 36).check([0])


def test_a_lossless_film_gives_every_pixel_back(tmp_path):
    frames = np.random.default_rng(0).integers(0, 256, (5, 48, 64, 3), np.uint8)
    key, columns = "observation.images.side", {"timestamp": np.arange(5, dtype=np.float32) / 10}
    columns |= {"action": np.zeros((5, 2), np.float32)}
    write_data_set(tmp_path, [LeRobotRows(columns, {key: frames})], {}, "look", 10, lossless=True)
    (opened,) = open_recordings([Source(name="s", path=str(tmp_path))]).recordings
    np.testing.assert_array_equal([*opened.cameras()["side"].read(range(5))], frames)
