"""The border of recordings: how they are refused, and how much one file of them may ask for."""

from collections.abc import Generator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Annotated, Any

import av
from av.container import InputContainer
from av.video.stream import VideoStream
from PIL import Image, UnidentifiedImageError
from pydantic import Field

from pipeline.base.border import Border, Document, Text, shown
from pipeline.base.config import MediaLimits
from pipeline.base.errors import RecordingError

RECORDINGS = Border(RecordingError, "Copy the file again, or leave the episode out.")

DEFAULT_LIMITS = MediaLimits()
"""Of a file that is of no source."""
FARTHEST_S = 1e20
"""No clock is farther from zero: nanoseconds since 1970 are 1e18."""
Seconds = Annotated[float, Field(ge=-FARTHEST_S, le=FARTHEST_S)]
Rate = Annotated[float, Field(ge=1e-3, le=1e6)]
"""Of a stream, in Hz."""

_ALWAYS_TAKEN = 256 * 2**20
"""Unpacked bytes that no ratio forbids: what stands still packs a thousandfold."""
_IMAGES = ("JPEG", "PNG")
_SCAN, _MOST_SCANS = b"\xff\xda", 100
"""A progressive JPEG has about ten; each goes over all pixels again."""
_CODECS = ("av1", "h264", "hevc", "mjpeg", "mpeg4", "vp8", "vp9")
_AV1_DECODERS = frozenset({"libdav1d", "libaom-av1", "libgav1"})
_CONTAINERS = {"format_whitelist": "mov,mp4,matroska,webm,avi", "protocol_whitelist": "file"}
"""No playlist, and nothing that opens another file."""

Image.MAX_IMAGE_PIXELS = None  # The limits of a source are held against the header instead.


class Grouped(Document):
    """What the metadata of an episode of any format may say."""

    group: Text | Annotated[int, Field(ge=-(10**9), lt=10**9)] | None = None

    @property
    def group_name(self) -> str | None:
        """What the episode belongs to with others; None where it says nothing."""
        return None if self.group in (None, "") else str(self.group)


def check_unpacked(where: Path | str, unpacked: int, packed: int, limits: MediaLimits) -> None:
    """Refuse an array or a table of so many bytes in so many bytes of a file, before it is read."""
    ratio = max(_ALWAYS_TAKEN, int(limits.ratio * packed))
    for most, name in ((limits.array_bytes, "array_bytes"), (ratio, "ratio")):
        _check_limit(where, unpacked, most, name, "bytes unpacked")


@contextmanager
def opened_image(
    file: Path | bytes, where: str, limits: MediaLimits
) -> Generator[Image.Image, None, None]:
    """An open JPEG or PNG; what goes wrong inside is a `RecordingError` that begins with `where`.

    Its pixels are within the limits, by its header: nothing is decoded yet.
    """
    if isinstance(file, Path):
        file = RECORDINGS.read_bytes(file, RECORDINGS.check_file(file))
    with RECORDINGS.foreign(where, "cannot be decoded as an image"):
        try:
            image = Image.open(BytesIO(file), formats=_IMAGES)
        except UnidentifiedImageError:
            why = f"cannot be decoded as an image: expected a JPEG or PNG, found {shown(file[:16])}"
            raise RECORDINGS.refusal(where, why) from None
        with image:
            _check_limit(where, image.width * image.height, limits.pixels, "pixels", "pixels")
            if (scans := file.count(_SCAN)) > _MOST_SCANS and image.format != "PNG":
                why = f"expected at most {_MOST_SCANS} scans over the image, found {scans:,}"
                raise RECORDINGS.refusal(where, why)
            yield image


@contextmanager
def opened_video(
    path: Path, limits: MediaLimits
) -> Generator[tuple[InputContainer, VideoStream], None, None]:
    """An open video and its first stream; what goes wrong inside is a `RecordingError`.

    Its frames are within the limits, by its header and wherever one is decoded.
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
        if codec == "av1" and not _AV1_DECODERS & av.codecs_available:
            raise RecordingError(
                f"{path}: the video is AV1 and this PyAV build decodes none; "
                "install a wheel that has libdav1d: pip install --upgrade av"
            )
        _check_limit(path, context.width * context.height, limits.pixels, "pixels", "pixels")
        context.options = {"max_pixels": str(limits.pixels)}
        context.thread_count = 1
        yield container, stream


def _check_limit(where: Path | str, found: int, most: int, name: str, what: str) -> None:
    if found > most:
        raise Border(
            RecordingError,
            f"Leave the episode out, or if this is right, raise limits.{name} of its source.",
        ).refusal(where, f"expected at most {most:,} {what}, found {found:,}")
