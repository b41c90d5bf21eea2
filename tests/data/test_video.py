"""Frames by number, from whole files and from parts of shared ones."""

import av
import numpy as np
import pytest

from pipeline.base.errors import RecordingError
from pipeline.data.video import VideoClip, VideoSpan

ENCODINGS = [
    *((codec, group, 0) for codec in ("libx264", "mpeg4", "libsvtav1") for group in (1, 4, 40)),
    # Frames shown in another order than they are decoded in, across key frames too.
    *((codec, 5, 2) for codec in ("libx264", "mpeg4")),
]


def clip(path, rows: int, first: int | None = None, count: int | None = None) -> VideoClip:
    return VideoClip("top", np.arange(rows) / 10, VideoSpan(path, first, count), 10.0)


def shades(frames) -> list[int]:
    """The shade of the plain corner of each frame, to the nearest of the writer's."""
    return [round((int(frame[-4, -4].mean()) - 20) / 11) for frame in frames]


@pytest.fixture(params=ENCODINGS, ids=lambda encoding: "-".join(map(str, encoding)))
def path(request, tmp_path, write):
    codec, group, b_frames = request.param
    if codec not in av.codecs_available:
        pytest.skip(f"this PyAV build has no {codec}")
    numbers = [20 + 11 * (frame % 18) for frame in range(36)]
    return write.video(tmp_path / "a.mp4", numbers, 10, codec, group, b_frames)


@pytest.mark.parametrize(
    "indices",
    [
        range(36),
        range(0, 36, 3),
        [0],
        [35],
        [7, 7, 7, 8],
        [1, 30, 31, 35, 35],
        [],
    ],
)
def test_whole_file(path, indices):
    camera = clip(path, 36)
    camera.check(indices)
    assert shades(camera.read(indices)) == [index % 18 for index in indices]


@pytest.mark.parametrize(("first", "rows"), [(0, 12), (12, 11), (23, 13), (5, 1), (35, 1)])
def test_part_of_a_shared_file(path, first, rows):
    camera = clip(path, rows, first, rows)
    assert shades(camera.read(range(rows))) == [(first + row) % 18 for row in range(rows)]
    assert shades(camera.read([rows - 1])) == [(first + rows - 1) % 18]


def test_a_part_is_bit_identical_to_the_whole(path):
    whole = list(clip(path, 36).read(range(36)))
    part = list(clip(path, 10, 20, 10).read(range(10)))
    assert all(np.array_equal(a, b) for a, b in zip(whole[20:30], part, strict=True))


@pytest.mark.parametrize("group", [1, 4, 40])
def test_frames_of_one_time_are_counted(tmp_path, write, group):
    # Matroska counts milliseconds: three frames share each.
    numbers = [20 + 11 * (frame % 18) for frame in range(36)]
    path = write.video(tmp_path / "a.mkv", numbers, 3000, "libx264", group)
    camera = clip(path, 36)
    for indices in [*([index] for index in range(36)), [1, 2, 35], [4, 9, 11], range(36)]:
        assert shades(camera.read(indices)) == [index % 18 for index in indices]


def test_a_container_of_another_rate_pairs_by_number(tmp_path, write):
    path = write.video(tmp_path / "a.mp4", [20 + 11 * f for f in range(15)], fps=30)
    assert shades(clip(path, 15).read(range(15))) == list(range(15))


@pytest.mark.parametrize(
    ("rows", "first", "count", "message"),
    [
        (35, None, None, "36 frames of view 'top' but 35 rows"),
        (37, None, None, "36 frames of view 'top' but 37 rows"),
        (10, 30, 10, "6 frames of view 'top' but 10 rows"),
        (10, 0, 11, "11 frames of view 'top' but 10 rows"),
        (10, 90, 10, "0 frames of view 'top' but 10 rows"),
    ],
)
def test_counts_that_disagree_are_both_named(tmp_path, write, rows, first, count, message):
    path = write.video(tmp_path / "a.mp4", [50] * 36)
    for attempt in (lambda c: c.check([0]), lambda c: list(c.read([0])), lambda c: c.check([])):
        with pytest.raises(RecordingError, match=rf"a\.mp4: {message}"):
            attempt(clip(path, rows, first, count))


@pytest.mark.parametrize("damage", ["empty", "text", "truncated", "absent"])
def test_an_unreadable_file_is_named(tmp_path, write, damage):
    path = write.video(tmp_path / "a.mp4", list(range(0, 216, 6)))
    whole = path.read_bytes()
    if damage == "absent":
        path.unlink()
    else:
        path.write_bytes(
            {"empty": b"", "text": b"hello " * 99, "truncated": whole[: len(whole) // 2]}[damage]
        )
    with pytest.raises(RecordingError, match=r"a\.mp4"):
        clip(path, 36).check([0])


def test_a_file_cut_off_behind_its_index_is_found_by_check(tmp_path, write):
    slow = write.video(tmp_path / "slow.mp4", list(range(0, 216, 6)))
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
    whole = path.read_bytes()
    assert clip(path, 36).check([0]) is None
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
    if codec not in av.codecs_available:
        pytest.skip(f"this PyAV build has no {codec}")
    path = write.video(tmp_path / "a.mp4", list(range(0, 216, 6)), codec=codec, group=1)
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


def test_a_file_without_video_is_named(tmp_path):
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(RecordingError, match=r"a\.mp4: holds no video"):
        clip(path, 36).check([0])


def test_what_is_no_video_is_named_once_and_in_words(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"no video")
    with pytest.raises(RecordingError) as caught:
        clip(path, 36).check([0])
    said = str(caught.value)
    assert (
        said.startswith(f"{path}: cannot be read as video (MP4, ") and "Invalid data found" in said
    )
    assert said.count(str(path)) == 1 and "Errno" not in said


def test_a_build_without_av1_says_so(tmp_path, write, monkeypatch):
    if "libsvtav1" not in av.codecs_available:
        pytest.skip("this PyAV build writes no AV1")
    path = write.video(tmp_path / "a.mp4", [50] * 8, codec="libsvtav1")
    monkeypatch.setattr(av, "codecs_available", {"h264"})
    with pytest.raises(RecordingError, match=r"AV1.*pip install --upgrade av"):
        clip(path, 8).check([0])
