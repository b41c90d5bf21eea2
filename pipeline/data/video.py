"""Frames of a video file, by number, decoded one at a time.

LeRobot pairs rows with frames by number. A frame's number is its rank by presentation time in its
clip. A clip is the whole file, or the part of a shared file that holds one episode.
"""

import sys
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from numpy.typing import NDArray

from pipeline.base.config import MediaLimits
from pipeline.base.errors import RecordingError
from pipeline.data.recording import DEFAULT_LIMITS, RECORDINGS, CameraStream, check_limit

_CODECS = ("av1", "h264", "hevc", "mjpeg", "mpeg4", "vp8", "vp9")
_CONTAINERS = {"format_whitelist": "mov,mp4,matroska,webm,avi", "protocol_whitelist": "file"}
"""No playlists, and no format that opens other files."""
_MOST_SEEKS = 1000


@dataclass(frozen=True)
class VideoSpan:
    """An episode's frames in a video file: all frames where `first` is None."""

    path: Path
    first: int | None = None
    count: int | None = None
    """How many frames the metadata name; None where they do not say."""


class _FrameTable(NamedTuple):
    """Times of a clip's frames in the container's units, in presentation order: (frame,) each."""

    pts: NDArray[np.int64]
    key_pts: NDArray[np.int64]
    """The key frame from which decoding must start."""
    key_dts: NDArray[np.int64]


class VideoClip(CameraStream):
    """A view whose frames are in a video; `time` has one entry per row of the episode."""

    def __init__(
        self,
        view: str,
        time: NDArray[np.float64],
        span: VideoSpan,
        fps: float,
        limits: MediaLimits = DEFAULT_LIMITS,
    ) -> None:
        self.view = view
        self.time = time
        self._span = span
        self._fps = fps
        self._limits = limits

    def check(self, indices: Sequence[int]) -> None:
        """Read every packet of the clip and decode these frames, with one in memory at a time.

        So it finds a missing, truncated or undecodable file, a frame count other than the rows',
        and damage inside a packet if the decoder notices it.
        """
        for _ in self._frames(sorted(set(indices))):
            pass

    def read(self, indices: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
        last, image = None, None
        for frame in self._frames(indices):
            if image is None or frame is not last:
                last, image = frame, np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
            yield image

    def _frames(self, indices: Sequence[int]) -> Iterator[VideoFrame]:
        """The frames before conversion to RGB; the same object where an index repeats."""
        table = self._table
        start = table.pts[0] if len(table.pts) else 0
        with opened_video(self._span.path, self._limits) as (container, stream):
            decoded: Iterator[VideoFrame] = iter(())
            at, frame = -1, None
            for index in indices:
                assert index >= at, "frames are read in never decreasing order"
                if frame is None or index != at:
                    # Complete groups of pictures between two frames are skipped, not decoded.
                    if frame is None or table.key_pts[index] > table.pts[at + 1]:
                        # A new container stands at its first frame.
                        if frame is not None or self._span.first or table.key_pts[index] > start:
                            container.seek(int(table.key_dts[index]), stream=stream)
                        decoded = iter(container.decode(stream))
                    frame, at = self._decode_until(decoded, index), index
                yield frame

    def _decode_until(self, decoded: Iterator[VideoFrame], index: int) -> VideoFrame:
        pts, key_pts, reason = int(self._table.pts[index]), int(self._table.key_pts[index]), ""
        try:
            for frame in decoded:
                if frame.pts == pts and not frame.is_corrupt:
                    return frame
                # A damaged frame after the key frame spoils the frames predicted from it.
                spoilt = frame.is_corrupt and frame.pts is not None and frame.pts >= key_pts
                if frame.pts is None or frame.pts >= pts or spoilt:
                    break
        except av.FFmpegError as error:
            reason = f" ({error.strerror})"
        raise RecordingError(
            f"{self._span.path}: frame {index} of view {self.view!r} cannot be decoded{reason}; "
            "the video is damaged there: copy the file again"
        )

    @cached_property
    def _table(self) -> _FrameTable:
        rows, span = len(self.time), self._span
        with opened_video(self._span.path, self._limits) as (container, stream):
            packets = list(_packets(container, stream, span, self._fps, rows))
        for count in (len(packets), span.count):
            if count is not None and count != rows:
                raise RecordingError(
                    f"{span.path}: {count} frames of view {self.view!r} but {rows} rows; they "
                    "pair by number, so the counts must agree. Copy the video again, or leave "
                    "the episode out"
                )
        table = np.array(sorted(packets, key=itemgetter(0)), np.int64).reshape(-1, 3).T
        if (same := np.flatnonzero(np.diff(table[0]) == 0)).size:
            why = f"frames {same[0]} and {same[0] + 1} of view {self.view!r} have the same time"
            raise RECORDINGS.refusal(span.path, f"{why}, so that no seek tells them apart")
        return _FrameTable(*table)


@contextmanager
def opened_video(
    path: Path, limits: MediaLimits
) -> Generator[tuple[InputContainer, VideoStream], None, None]:
    """An open video and its first stream; an error inside becomes a `RecordingError`.

    The header and the decoder both keep the frames within the limits.
    """
    RECORDINGS.check_file(path)
    unreadable = "cannot be read as video (MP4, Matroska, WebM or AVI)"
    with (
        RECORDINGS.foreign(path, unreadable),
        av.open(f"file:{path}", container_options=_CONTAINERS) as container,
    ):
        if not container.streams.video:
            raise RECORDINGS.refusal(path, "holds no video")
        stream = container.streams.video[0]
        context: Any = stream.codec_context
        codec = context.codec.canonical_name if context else "one that PyAV does not know"
        if codec not in _CODECS:
            raise RECORDINGS.refusal(
                path, f"expected a video of {', '.join(_CODECS)}, found {codec}"
            )
        check_limit(path, context.width * context.height, limits.pixels, "pixels", "pixels")
        context.options = {"max_pixels": str(limits.pixels)}
        context.thread_count = 1
        yield container, stream


def frame_count(path: Path, limits: MediaLimits) -> int:
    """The number of frames in a video's header; 0 where it is missing or unreadable."""
    with suppress(RecordingError), opened_video(path, limits) as (_, stream):
        return stream.frames
    return 0


def _packets(
    container: InputContainer, stream: VideoStream, span: VideoSpan, fps: float, rows: int
) -> Iterator[tuple[int, int, int]]:
    """`pts`, `key_pts`, `key_dts` of the clip's frames, in decoding order; decodes none."""
    if stream.time_base is None:
        raise RecordingError(f"{span.path}: the video has no time base")
    start, step = stream.start_time or 0, 1 / (fps * float(stream.time_base))
    wanted = range(sys.maxsize) if span.first is None else range(span.first, span.first + rows)
    if wanted.start:
        _seek_before(container, stream, start + round((wanted.start - 0.5) * step))
    keys: list[tuple[int, int]] = []
    for packet in container.demux(stream):
        if packet.size == 0:
            continue  # the flush at the end
        if packet.pts is None or packet.is_corrupt:
            raise RecordingError(f"{span.path}: a packet is cut off or has no time")
        dts = packet.pts if packet.dts is None else packet.dts
        if dts - start > wanted.stop * step:
            return
        if packet.is_keyframe:
            keys = [*keys[-1:], (packet.pts, dts)]
        if keys and round((packet.pts - start) / step) in wanted:
            # A frame shown before the newest key frame depends on the previous key frame.
            yield (packet.pts, *(keys[-1] if packet.pts >= keys[-1][0] else keys[0]))


def _seek_before(container: InputContainer, stream: VideoStream, pts: int) -> None:
    """Seek to a key frame that is shown at or before `pts`.

    A seek uses decoding times, so the key frame that it finds may be shown later.
    """
    target = pts
    for _ in range(_MOST_SEEKS):
        container.seek(target, stream=stream)
        packet = next(packet for packet in container.demux(stream))
        if packet.pts is None or packet.pts <= pts or packet.dts is None or packet.dts >= target:
            break
        target = packet.dts - 1
    container.seek(target, stream=stream)
