"""Folders of JPEGs as camera streams: a frame's time is in its file's name."""

import math
import os
import re
from collections import Counter, defaultdict
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from filecmp import cmp
from io import BytesIO
from itertools import pairwise
from pathlib import Path, PurePath
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from pipeline.base.border import shown
from pipeline.base.config import MediaLimits
from pipeline.base.errors import RecordingError
from pipeline.data.recording import (
    DEFAULT_LIMITS,
    FARTHEST_S,
    INTACT,
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
_PADDED = re.compile(r"0\d+")
"""A frame number in place of a time: 000001."""
_COUNTS = 1e6
"""Whole numbers below it count frames; a clock in whole seconds since 1970 is above 1e9."""
_VIEW = re.compile(r"view(?=\d)", re.IGNORECASE)
_FORMATS = ("JPEG", "PNG")
_AS_RGB = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK")
"""Modes of images that are converted to RGB; transparent pixels become opaque."""
_SIXTEEN_BITS = ("I;16", "I;16B", "I;16L", "I;16N")
"""Modes of grey images of 16 bits; the upper eight bits are kept."""
_IMAGE_BYTES = 16 * 2**20
"""Bytes that an image file may have above one per pixel of the limits; a JPEG has about half."""
_SCAN, _MOST_SCANS = b"\xff\xda", 100
"""A progressive JPEG has about ten scans; each goes over all pixels again."""

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
        _check_one_camera(view, timed)
        _check_not_counted(timed)
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
    if not abs(time) <= FARTHEST_S or _PADDED.fullmatch(text):
        raise _no_time(path, shown(text))
    return time


def _check_not_counted(timed: Sequence[tuple[float, str]]) -> None:
    """Raise `RecordingError` where the names only count the frames: whole numbers below 1e6."""
    if len(timed) < 2 or timed[-1][0] >= _COUNTS:
        return
    if all(PurePath(path).stem.rpartition("_")[2].isdecimal() for _, path in timed):  # not 1.0
        first, last = timed[0][0], timed[-1][0]
        raise _no_time(Path(timed[-1][1]), f"frames counted from {first:g} to {last:g}")


def _no_time(path: PurePath, name: str) -> RecordingError:
    return RecordingError(
        f"{path}: expected a name that ends in the time in seconds, such as "
        f"zed_left_1761551500.174.jpg, found {name}. Rename the frames by their times"
    )


def _check_one_camera(view: str, timed: Sequence[tuple[float, str]]) -> None:
    """Raise `RecordingError` where frames (sorted by time) are of two cameras or in two forms.

    The part of a name before the time is the camera's name, or a number of the frame's own.
    """
    names = {path: os.path.basename(path).rpartition("_")[0] for _, path in timed}  # noqa: PTH119
    of_camera = {name: path for path, name in names.items()}
    pairs = [[a, b] for (at, a), (then, b) in pairwise(timed) if at == then and a != b]
    if 1 < len(of_camera) < len(names):
        pairs.append([*of_camera.values()])
    if pairs:
        raise _two_cameras(view, *pairs[0][:2])


def _two_cameras(view: str, first: str | Path, other: str | Path) -> RecordingError:
    return RecordingError(
        f"{first}: expected the frames of one camera in {view}, found also {other}. Move those "
        "of another camera or form into a folder of their own"
    )


def list_views(folder: Path, prefix: str = "") -> dict[str, list[Path]]:
    """Images by view name, from the folders `<prefix>…` in `folder`; without empty views.

    `left` is dropped unless both eyes exist. The eye is a subfolder, the end of the folder's name,
    or the part of a file's name before the time.
    """
    frames: dict[tuple[str, str], list[Path]] = defaultdict(list)
    for view in _view_folders(folder, prefix):
        base, _ = split_eye(view.name)
        firsts: dict[str, Path] = {}
        for eye, path in _frames(view):
            frames[base, eye].append(path)
            firsts.setdefault(eye, path)
        if "" in firsts and len(firsts) > 1:
            first, other, *_ = firsts.values()
            raise _two_cameras(view.name, first, other)
    return name_views(frames)


def list_empty_views(folder: Path, prefix: str = "") -> list[str]:
    """The folders `<prefix>…` in `folder` with no image in them or their eyes' subfolders."""
    return [
        view.name for view in _view_folders(folder, prefix) if next(_frames(view), None) is None
    ]


def name_views(frames: Mapping[tuple[str, str], list[Frame]]) -> dict[str, list[Frame]]:
    """Frames by view name, from (base, eye): the eye is in the name only where both exist."""
    eyes = Counter(base for base, _ in frames)
    return {
        base if eyes[base] == 1 or not eye else f"{base}_{eye}": frames[base, eye]
        for base, eye in sorted(frames, key=lambda key: natural_key("_".join(key)))
    }


def split_eye(name: str) -> tuple[str, str]:
    """`View1_left` and `view1_left` -> (`View1`, `left`); the eye is '' if there is none."""
    name = _VIEW.sub("View", name, count=1) if _VIEW.match(name) else name
    base, _, eye = name.rpartition("_")
    return (base, eye) if base and eye in _EYES else (name, "")


def read_image(
    file: Path | bytes, where: str, limits: MediaLimits = DEFAULT_LIMITS
) -> NDArray[np.uint8]:
    """The image (height, width, 3), RGB as stored (EXIF orientation is ignored)."""
    with _opened_image(file, where, limits) as image:
        if image.mode in _SIXTEEN_BITS:
            upper = (np.asarray(image) >> 8).astype(np.uint8)
            return np.repeat(upper[:, :, None], 3, axis=2)
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
            if image.mode not in _AS_RGB + _SIXTEEN_BITS:
                why = f"expected pixels of 8 bits, or grey ones of 16, found mode {image.mode!r}"
                raise INTACT.refusal(where, why)
            if image.format == "JPEG" and (scans := file.count(_SCAN)) > _MOST_SCANS:
                why = f"expected at most {_MOST_SCANS} scans over the image, found {scans:,}"
                raise INTACT.refusal(where, why)
            yield image


def check_image_file(file: Path, limits: MediaLimits) -> int:
    """The size of a regular file; refused if no image within the limits needs so many bytes."""
    size = RECORDINGS.check_file(file)
    check_limit(file, size, _IMAGE_BYTES + limits.pixels, "pixels", "bytes")
    return size


def _view_folders(folder: Path, prefix: str) -> list[Path]:
    views = [
        Path(entry.path)
        for entry in _entries(folder)
        if split_eye(entry.name)[0].startswith(prefix) and entry.is_dir()
    ]
    for view, other in pairwise(sorted(views, key=lambda view: split_eye(view.name))):
        if split_eye(view.name) == split_eye(other.name):
            raise RecordingError(
                f"{view}: expected one folder of this view, found {other}. Rename it"
            )
    return sorted(views, key=lambda view: natural_key(view.name))


def _frames(view: Path) -> Iterator[tuple[str, Path]]:
    """(eye, file) of every image of a view's folder."""
    _, eye = split_eye(view.name)
    for entry in _entries(view):
        if entry.name in _EYES and entry.is_dir():
            inside = _entries(Path(entry.path))
            yield from ((entry.name, Path(file.path)) for file in inside if _is_image(file.name))
        elif _is_image(entry.name):
            yield eye or _eye_of_file(entry.name), Path(entry.path)


def _entries(folder: Path) -> Iterable[os.DirEntry[str]]:
    listed = entries(folder) if folder.is_dir() else []
    return [entry for entry in listed if not entry.name.startswith(".")]


def _is_image(name: str) -> bool:
    return name.lower().endswith(_SUFFIXES)


def _eye_of_file(name: str) -> str:
    parts = name.split("_")
    return parts[-2] if len(parts) > 2 and parts[-2] in _EYES else ""
