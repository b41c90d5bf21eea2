"""The border for recordings: how they are refused, and the limits of one of their files."""

from collections.abc import Generator
from contextlib import contextmanager
from io import SEEK_CUR, BytesIO
from pathlib import Path
from typing import IO, Annotated, Any

import av
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from pydantic import Field

from pipeline.base.border import Border, Document, Text, shown
from pipeline.base.config import MediaLimits
from pipeline.base.errors import RecordingError

RECORDINGS = Border(RecordingError, "Copy the file again, or leave the episode out.")
INTACT = Border(RecordingError, "Write the file again as expected, or leave the episode out.")
"""Refuses an undamaged file; a new copy would be refused too."""

DEFAULT_LIMITS = MediaLimits()
"""Limits of a file that does not belong to a source."""
FARTHEST_S = 1e20
"""Largest absolute time: nanoseconds since 1970 are 1e18."""
Seconds = Annotated[float, Field(ge=-FARTHEST_S, le=FARTHEST_S)]
Rate = Annotated[float, Field(ge=1e-3, le=1e6)]
"""Rate of a stream, in Hz."""

_ALWAYS_TAKEN = 256 * 2**20
"""Unpacked bytes that are allowed at any ratio: a constant stream is packed a thousandfold."""
_IMAGES = ("JPEG", "PNG")
_AS_RGB = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK")
"""Modes of images that are converted to RGB; transparent pixels become opaque."""
_SIXTEEN_BITS = ("I;16", "I;16B", "I;16L", "I;16N")
"""Modes of grey images of 16 bits; the upper eight bits are kept."""
_IMAGE_BYTES = 16 * 2**20
"""Bytes that an image file may have above one per pixel of the limits; a JPEG has about half."""
_SCAN, _MOST_SCANS = b"\xff\xda", 100
"""A progressive JPEG has about ten scans; each goes over all pixels again."""
_PNG, _MOST_CHUNKS = b"\x89PNG\r\n\x1a\n", 100_000
"""Pillow takes 5 µs per chunk, even for an empty one; FFmpeg writes chunks of 4 KiB."""
_CODECS = ("av1", "h264", "hevc", "mjpeg", "mpeg4", "vp8", "vp9")
_AV1_DECODERS = frozenset({"libdav1d", "libaom-av1", "libgav1"})
_CONTAINERS = {"format_whitelist": "mov,mp4,matroska,webm,avi", "protocol_whitelist": "file"}
"""No playlists, and no format that opens other files."""

Image.MAX_IMAGE_PIXELS = None  # The header is compared with the source's limits instead.


class Grouped(Document):
    """Metadata of an episode that may name its group."""

    group: Text | Annotated[int, Field(ge=-(10**9), lt=10**9)] | None = None

    @property
    def group_name(self) -> str | None:
        """The episode's group as text; None where it names none."""
        return None if self.group in (None, "") else str(self.group)


def check_unpacked(where: Path | str, unpacked: int, packed: int, limits: MediaLimits) -> None:
    """Refuse an array or table with too many unpacked bytes, or too high a ratio, before a read."""
    ratio = max(_ALWAYS_TAKEN, int(limits.ratio * packed))
    for most, name in ((limits.array_bytes, "array_bytes"), (ratio, "ratio")):
        check_limit(where, unpacked, most, name, "bytes unpacked")


def check_image_file(file: Path, limits: MediaLimits) -> int:
    """The size of a regular file; refused if no image within the limits needs so many bytes."""
    size = RECORDINGS.check_file(file)
    check_limit(file, size, _IMAGE_BYTES + limits.pixels, "pixels", "bytes")
    return size


@contextmanager
def opened_image(
    file: Path | bytes, where: str, limits: MediaLimits
) -> Generator[Image.Image, None, None]:
    """An open JPEG or PNG; an error inside becomes a `RecordingError` that begins with `where`.

    Its header says that its pixels are within the limits; nothing is decoded yet.
    """
    if isinstance(file, Path):
        check_image_file(file, limits)
    unreadable = "cannot be decoded as an image"
    with (
        RECORDINGS.foreign(where, unreadable),
        BytesIO(file) if isinstance(file, bytes) else file.open("rb") as stream,
    ):
        if _chunks(stream) > _MOST_CHUNKS:
            raise INTACT.refusal(where, f"expected a PNG of at most {_MOST_CHUNKS:,} chunks")
        try:
            image = Image.open(stream, formats=_IMAGES)
        except UnidentifiedImageError:
            stream.seek(0)
            why = f"{unreadable}: expected a JPEG or PNG, found {shown(stream.read(16))}"
            raise RECORDINGS.refusal(where, why) from None
        with image:
            check_limit(where, image.width * image.height, limits.pixels, "pixels", "pixels")
            if image.mode not in _AS_RGB + _SIXTEEN_BITS:
                why = f"expected pixels of 8 bits, or grey ones of 16, found mode {image.mode!r}"
                raise INTACT.refusal(where, why)
            if (scans := _scans(image, stream)) > _MOST_SCANS:
                why = f"expected at most {_MOST_SCANS} scans over the image, found {scans:,}"
                raise INTACT.refusal(where, why)
            yield image


def in_rgb(image: Image.Image) -> NDArray[np.uint8]:
    """The pixels (height, width, 3), RGB, of an image of `opened_image`."""
    if image.mode in _SIXTEEN_BITS:
        upper = (np.asarray(image) >> 8).astype(np.uint8)
        return np.repeat(upper[:, :, None], 3, axis=2)
    image.info.pop("transparency", None)  # Pillow would warn about a palette's transparency
    return np.asarray(image.convert("RGB"))


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
            raise INTACT.refusal(path, f"expected a video of {', '.join(_CODECS)}, found {codec}")
        if codec == "av1" and not _AV1_DECODERS & av.codecs_available:
            raise RecordingError(
                f"{path}: the video is AV1 and this PyAV build decodes none; "
                "install a wheel that has libdav1d: pip install --upgrade av"
            )
        check_limit(path, context.width * context.height, limits.pixels, "pixels", "pixels")
        context.options = {"max_pixels": str(limits.pixels)}
        context.thread_count = 1
        yield container, stream


def check_limit(where: Path | str, count: int, most: int, name: str, what: str) -> None:
    """Refuse a count above `limits.<name>` of its source."""
    if count > most:
        raise Border(
            RecordingError,
            f"Leave the episode out, or if this is right, raise limits.{name} of its source.",
        ).refusal(where, f"expected at most {most:,} {what}, found {count:,}")


def _chunks(stream: IO[bytes]) -> int:
    """Chunks of a PNG, counted up to one more than allowed; 0 for another file. Rewinds it."""
    count = 0
    if stream.read(len(_PNG)) == _PNG:
        while count <= _MOST_CHUNKS and len(head := stream.read(8)) == 8:
            stream.seek(int.from_bytes(head[:4]) + 4, SEEK_CUR)
            count += 1
    stream.seek(0)
    return count


def _scans(image: Image.Image, stream: IO[bytes]) -> int:
    """Scans of a JPEG; the whole file is read only if it may have several."""
    if image.format == "PNG":
        return 0
    first = 8 + 2 * getattr(image, "layers", 0)  # bytes of the header of a scan of all components
    stream.seek(max(0, stream.tell() - first))
    if "progressive" not in image.info and stream.read(first).rfind(_SCAN) == 0:
        return 1  # the decoder ignores later ones
    stream.seek(0)
    return stream.read().count(_SCAN)
