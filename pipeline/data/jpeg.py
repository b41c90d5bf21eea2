"""Folders of JPEGs as camera streams: a frame's time is in its file's name."""

import math
import os
from collections import Counter, defaultdict
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from filecmp import cmp
from io import BytesIO
from pathlib import Path, PurePath
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from pipeline.base.config import MediaLimits
from pipeline.base.documents import shown
from pipeline.base.errors import RecordingError
from pipeline.data.recording import (
    DEFAULT_LIMITS,
    FARTHEST_S,
    RECORDINGS,
    CameraStream,
    check_limit,
    entries,
    natural_key,
)

THUMBNAIL = (32, 18)
"""Width and height of the thumbnail of a checked JPEG."""

Frame = TypeVar("Frame")
_EYES = ("left", "right")
_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".gif", ".tif", ".tiff", ".webp")
"""Suffixes of images; those that cannot be decoded are refused with their name."""
_COUNTS = 1e6
"""Whole numbers below it count frames; a clock in whole seconds since 1970 is above 1e9."""
_FORMATS = ("JPEG", "PNG")
_AS_RGB = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK")
"""Modes of images that are converted to RGB; transparent pixels become opaque."""
_IMAGE_BYTES = 16 * 2**20
"""Bytes that an image file may have above one per pixel of the limits; a JPEG has about half."""
Image.MAX_IMAGE_PIXELS = None  # The header is compared with the source's limits instead.


class JpegCamera(CameraStream):
    """A view whose frames are files."""

    def __init__(
        self, view: str, paths: Sequence[Path], limits: MediaLimits = DEFAULT_LIMITS
    ) -> None:
        """Sorts the files by the time in their names.

        Raises `RecordingError` on a name without a time, on names that count the frames, and on
        frames of two cameras.
        """
        timed = sorted((frame_time(path), str(path)) for path in paths)
        _check_names(view, set(timed))
        self.view = view
        self.paths = [Path(path) for _, path in timed]
        self.time = np.array([time for time, _ in timed], np.float64)
        self._limits = limits

    def check(self, indices: Sequence[int]) -> NDArray[np.uint8] | None:
        files = [self.paths[index] for index in indices]
        checked = [check_image(file, str(file), self._limits) for file in files]
        thumbnails = [thumbnail for thumbnail in checked if thumbnail is not None]
        return np.stack(thumbnails) if files and len(thumbnails) == len(files) else None

    def read(self, indices: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
        last, frame = -1, None
        for index in indices:
            if frame is None or index != last:
                file = self.paths[index]
                last, frame = index, read_image(file, str(file), self._limits)
            yield frame

    def repeats(self) -> NDArray[np.bool_]:
        """Whether files are equal byte by byte; reads only files of equal length."""
        lengths = np.array([check_image_file(path, self._limits) for path in self.paths])
        same = lengths[1:] == lengths[:-1]
        for place in np.flatnonzero(same):
            same[place] = cmp(self.paths[place], self.paths[place + 1], shallow=False)
        return same


def frame_time(path: PurePath) -> float:
    """Seconds in the last `_`-separated part of the stem, as in `zed_left_1761551500.174.jpg`."""
    text = path.stem.rsplit("_", 1)[-1]
    try:
        time = float(text)
    except ValueError:
        time = math.nan
    if not abs(time) <= FARTHEST_S:
        raise _no_time(path, shown(text))
    return time


def _check_names(view: str, timed: Collection[tuple[float, str]]) -> None:
    """Raise `RecordingError` where frames are numbered, or of two cameras or in two forms.

    The part of a name before the time is the camera's name, or a number of the frame's own.
    """
    names = [os.path.basename(path).rpartition(".")[0] for _, path in timed]  # noqa: PTH119
    before, _, last = zip(*(name.rpartition("_") for name in names), strict=True)
    _, path = max(timed)
    if max(timed)[0] < _COUNTS and all(map(str.isdecimal, last)):  # not 1.0
        raise _no_time(Path(path), "the number of a frame")
    cameras, times = set(before), {time for time, _ in timed}
    if 1 < len(cameras) < len(names) or len(times) < len(timed):
        raise RecordingError(
            f"{path}: expected the frames of one camera in {view}, at different times; found "
            f"{len(cameras)} name(s) and {len(times)} times for {len(timed)} frames. Move those of "
            "another camera or form into a folder of their own"
        )


def _no_time(path: PurePath, name: str) -> RecordingError:
    return RecordingError(
        f"{path}: expected a name that ends in the time in seconds, such as "
        f"zed_left_1761551500.174.jpg, found {name}. Rename the frames by their times"
    )


def list_views(folder: Path, prefix: str = "") -> dict[str, list[Path]]:
    """Images by view name, from the folders `<prefix>…` in `folder` (`view1` too); none is empty.

    `left` is dropped unless both eyes exist. The eye is a subfolder, or ends the folder's name.
    """
    frames: dict[tuple[str, str], list[Path]] = defaultdict(list)
    for view in _folders(folder):
        if view.name.lower().startswith(prefix.lower()):
            base, eye = split_eye(view.name)
            frames[base, eye] += _images(view)
            for name in _EYES:
                frames[base, name] += _images(view / name)
    return name_views({key: paths for key, paths in frames.items() if paths})


def name_views(frames: Mapping[tuple[str, str], list[Frame]]) -> dict[str, list[Frame]]:
    """Frames by view name, from (base, eye): the eye is in the name only where both exist."""
    eyes = Counter(base for base, _ in frames)
    return {
        base if eyes[base] == 1 or not eye else f"{base}_{eye}": frames[base, eye]
        for base, eye in sorted(frames, key=lambda key: natural_key("_".join(key)))
    }


def split_eye(name: str) -> tuple[str, str]:
    """`View1_left` -> (`View1`, `left`); the eye is '' if there is none."""
    base, _, eye = name.rpartition("_")
    return (base, eye) if base and eye in _EYES else (name, "")


def read_image(
    file: Path | bytes, where: str, limits: MediaLimits = DEFAULT_LIMITS
) -> NDArray[np.uint8]:
    """The image (height, width, 3), RGB as stored (EXIF orientation is ignored)."""
    with _opened_image(file, where, limits) as image:
        image.info.pop("transparency", None)  # Pillow would warn about a palette's transparency
        return np.asarray(image.convert("RGB"))


def check_image(
    file: Path | bytes, where: str, limits: MediaLimits = DEFAULT_LIMITS
) -> NDArray[np.uint8] | None:
    """Raise `RecordingError` on an unreadable image.

    A JPEG is decoded at an eighth of its size; some of its pixels, evenly spread, are returned as a
    `THUMBNAIL`. A PNG is checked by its checksums and returns None.
    """
    with _opened_image(file, where, limits) as image:
        if image.format == "PNG":
            image.verify()
            return None
        image.draft("RGB", (max(1, image.width // 8), max(1, image.height // 8)))
        return np.asarray(image.resize(THUMBNAIL, Image.Resampling.NEAREST).convert("RGB"))


@contextmanager
def _opened_image(
    file: Path | bytes, where: str, limits: MediaLimits
) -> Generator[Image.Image, None, None]:
    """An open JPEG or PNG; an error inside becomes a `RecordingError` that begins with `where`.

    Its header says that its pixels are within the limits; nothing is decoded yet.
    """
    unreadable = "cannot be decoded as an image"
    with RECORDINGS.foreign(where, unreadable):
        if isinstance(file, Path):
            check_image_file(file, limits)
            file = file.read_bytes()
        try:
            image = Image.open(BytesIO(file), formats=_FORMATS)
        except UnidentifiedImageError:
            why = f"{unreadable}: expected a JPEG or PNG, found {shown(file[:16])}"
            raise RECORDINGS.refusal(where, why) from None
        with image:
            check_limit(where, image.width * image.height, limits.pixels, "pixels", "pixels")
            if image.mode not in _AS_RGB:
                raise RECORDINGS.refusal(
                    where, f"expected pixels of 8 bits, found mode {image.mode!r}"
                )
            yield image


def check_image_file(file: Path, limits: MediaLimits) -> int:
    """The size of a regular file; refused if no image within the limits needs so many bytes."""
    size = RECORDINGS.check_file(file)
    check_limit(file, size, _IMAGE_BYTES + limits.pixels, "pixels", "bytes")
    return size


def _folders(folder: Path) -> list[Path]:
    """The folders in a folder that are not hidden, in natural order; none where it is missing."""
    listed = entries(folder) if folder.is_dir() else []
    shown = (entry for entry in listed if not entry.name.startswith("."))
    return sorted((Path(entry.path) for entry in shown if entry.is_dir()), key=natural_key)


def _images(folder: Path) -> list[Path]:
    listed = entries(folder) if folder.is_dir() else []
    names = [entry.name for entry in listed if not entry.name.startswith(".")]
    return [folder / name for name in names if name.lower().endswith(_SUFFIXES)]
