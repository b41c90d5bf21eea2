"""Three camera views of the bench, without perspective, so that they show no heights.

    View1  from the side, across the diagonal: the camera moves up and down with the arm, and a
           splash guard fixed to it hides everything below the needle's tip. A laser plane
           through the target draws a red stripe on the wall behind.
    View2  from above, fixed to the bench: the phantom, its sticker, and the needle held by its arm.
    View5  from the hand: the needle's tip stays in the middle of the image, the sticker moves.

The lenses are telecentric: distance changes neither the size nor the place of an object.
"""

from functools import cache
from io import BytesIO
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from pipeline.simulation.insertion import HUB_MM, NeedleInsertion, Scene

VIEWS: Final = ("View1", "View2", "View5")
WIDTH: Final = 224
HEIGHT: Final = 126

JPEG_QUALITY: Final = 75
"""JPEG quality of the recorder's frames; a policy sees these frames."""

_NOISE = 2.0
"""Standard deviation of the noise of a pixel's level."""
_OVERSAMPLING = 2
_SIZE = np.array([WIDTH, HEIGHT]) * _OVERSAMPLING
_MIDDLE = _SIZE / 2
_SIDE_PX_MM = 10.0 * _OVERSAMPLING
_BENCH_PX_MM = 8.0 * _OVERSAMPLING
_HAND_PX_MM = 7.0 * _OVERSAMPLING

_PHANTOM_MM: Final = np.array([13.4, 7.6])
"""Half extents of the phantom."""
_STICKER_MM, _MARK_MM = 3.6, 2.8
_HUB_RADIUS_MM, _SHAFT_MM, _ARM_MM = 1.25, 0.55, 0.6
_GUARD_TOP = 0.85
_ACROSS: Final = np.array([1.0, 1.0]) / np.sqrt(2.0)
"""The direction to the right in the side camera's image, in x and y of the bench."""

_BENCH, _WALL, _GUARD = (96, 104, 112), (206, 212, 216), (58, 62, 68)
_SKIN, _SKIN_EDGE = (232, 190, 168), (196, 146, 124)
_STICKER, _MARK, _LASER = (250, 250, 246), (214, 24, 30), (226, 40, 40)
_STEEL, _HUB, _ARM = (70, 74, 84), (20, 44, 140), (120, 124, 132)

_Point = NDArray[np.float64]
_Draw = ImageDraw.ImageDraw
_Colour = tuple[int, int, int]


def render(view: str, scene: Scene) -> NDArray[np.uint8]:
    """The image (126, 224, 3), RGB, of one of `VIEWS`."""
    image = Image.new("RGB", (int(_SIZE[0]), int(_SIZE[1])), _WALL if view == "View1" else _BENCH)
    _VIEWS[view](ImageDraw.Draw(image), scene)
    return _exposure(scene.brightness)[np.asarray(image.reduce(_OVERSAMPLING))]


def photograph(view: str, insertion: NeedleInsertion, time_s: float) -> NDArray[np.uint8]:
    """A camera's frame at a past time of the episode: the image with the camera's noise.

    The same episode, view and time give the same bits.
    """
    image = render(view, insertion.scene(time_s))
    # A recording's clock in whole milliseconds may begin a little before the episode.
    seed = [insertion.layout.seed, 104, VIEWS.index(view), max(0, round(time_s * 1e4))]
    level = np.random.default_rng(seed).standard_normal(image.shape, np.float32)
    # In place: every copy of a frame costs as much as this arithmetic.
    level *= _NOISE
    level += image
    np.clip(np.rint(level, out=level), 0, 255, out=level)
    return level.astype(np.uint8)


def through_jpeg(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image as it is read from a recording."""
    file = BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=JPEG_QUALITY)
    return np.asarray(Image.open(file))


@cache
def _exposure(brightness: float) -> NDArray[np.uint8]:
    """(256,) the level that each level becomes."""
    return np.minimum(np.rint(np.arange(256) * brightness), 255).astype(np.uint8)


def _draw_side(draw: _Draw, scene: Scene) -> None:
    stripe = _MIDDLE[0] + _SIDE_PX_MM * float(scene.target_mm @ _ACROSS)
    half = _SIDE_PX_MM * _MARK_MM / 2
    draw.rectangle((stripe - half, 0, stripe + half, _SIZE[1]), fill=_LASER)
    across = _MIDDLE[0] + _SIDE_PX_MM * float(scene.needle_mm @ _ACROSS)
    tip = np.array([across, _GUARD_TOP * _SIZE[1]])
    hub = tip + _SIDE_PX_MM * np.array([float(scene.lean_mm @ _ACROSS), -HUB_MM])
    # The tip goes a little behind the guard, so that its end never shows.
    _line(draw, hub, tip + 0.1 * (tip - hub), _SIDE_PX_MM * _SHAFT_MM, _STEEL)
    size = _SIDE_PX_MM * _HUB_RADIUS_MM
    draw.rectangle((hub[0] - size, 0, hub[0] + size, hub[1]), fill=_HUB)
    draw.rectangle((0, _GUARD_TOP * _SIZE[1], *_SIZE), fill=_GUARD)


def _draw_above(draw: _Draw, scene: Scene) -> None:
    _phantom(draw, np.zeros(2), scene.target_mm, _BENCH_PX_MM)
    tip = _pixels(scene.needle_mm, _BENCH_PX_MM)
    hub = _pixels(scene.needle_mm + scene.lean_mm, _BENCH_PX_MM)
    _line(draw, hub, np.array([hub[0], -1.0]), _BENCH_PX_MM * _ARM_MM, _ARM)
    _line(draw, tip, hub, _BENCH_PX_MM * _SHAFT_MM, _STEEL)
    _disc(draw, hub, _BENCH_PX_MM * _HUB_RADIUS_MM, _HUB)


def _draw_from_hand(draw: _Draw, scene: Scene) -> None:
    _phantom(draw, -scene.needle_mm, scene.target_mm - scene.needle_mm, _HAND_PX_MM)
    _line(draw, _MIDDLE, _SIZE.astype(np.float64), 2 * _HAND_PX_MM * _SHAFT_MM, _STEEL)
    _disc(draw, _MIDDLE, _HAND_PX_MM * _SHAFT_MM * 1.4, _HUB)


def _phantom(draw: _Draw, middle_mm: _Point, target_mm: _Point, px_mm: float) -> None:
    middle, target = _pixels(middle_mm, px_mm), _pixels(target_mm, px_mm)
    low, high = middle - px_mm * _PHANTOM_MM, middle + px_mm * _PHANTOM_MM
    draw.rounded_rectangle(
        (*low, *high), radius=px_mm * 1.5, fill=_SKIN, outline=_SKIN_EDGE, width=int(px_mm / 2)
    )
    _disc(draw, target, px_mm * _STICKER_MM, _STICKER)
    _disc(draw, target, px_mm * _MARK_MM, _MARK)


def _pixels(place_mm: _Point, px_mm: float) -> _Point:
    """The pixel of a place relative to the middle of the image: x to the right, y upwards."""
    return _MIDDLE + px_mm * place_mm * [1.0, -1.0]


def _disc(draw: _Draw, middle: _Point, radius: float, colour: _Colour) -> None:
    draw.ellipse((*(middle - radius), *(middle + radius)), fill=colour)


def _line(draw: _Draw, start: _Point, end: _Point, width_px: float, colour: _Colour) -> None:
    draw.line((*start, *end), fill=colour, width=round(width_px))


_VIEWS: Final = {"View1": _draw_side, "View2": _draw_above, "View5": _draw_from_hand}
