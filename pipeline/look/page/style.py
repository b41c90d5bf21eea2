"""What all pictures share: colours, fonts, and how they become files.

The same numbers give the same bytes. The colours are from Okabe and Ito's palette, which
colour-blind readers can tell apart. Neutral shapes are drawn only in `INK` or `GRID`: a page
replaces these by its own colours, in light and in dark.
"""

import base64
import io
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from markupsafe import escape
from matplotlib import font_manager
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec
from numpy.typing import NDArray
from PIL import Image

INK = "#333333"
"""Text, axes, and everything else that is black on white paper."""
GRID = "#dddddd"
"""Grid lines, and areas behind data."""
PALETTE = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
"""Okabe and Ito's colours without those that cannot be seen on white or on black."""
_CJK = (
    *("Noto Sans CJK KR", "Noto Sans CJK JP", "Noto Sans CJK SC"),
    *("NanumGothic", "Malgun Gothic", "Microsoft YaHei", "Yu Gothic"),
    *("Apple SD Gothic Neo", "Hiragino Sans", "PingFang SC"),
)
"""Fonts of Debian, Windows and macOS that have Chinese, Japanese and Korean letters."""
RASTER_DPI = 144
"""Resolution of bitmaps inside the SVG."""
POINTS_INCH, POINT_PX = 72, 96 / 72
PHOTO_BYTES, PHOTO_RATIO, PHOTO_QUALITY = 2**15, 3, 88
"""An image of at least so many bytes that JPEG makes so many times smaller is a photograph."""
_NONE = dict.fromkeys(("Date", "Creator", "Format", "Type"))
"""Metadata that matplotlib writes into a file."""
FONTS = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Noto Sans', sans-serif"
COLOURS = {INK: "ink", "#000000": "ink", GRID: "grid", PALETTE[0]: "blue"}
"""Colours of a picture that follow the page's light or dark -> their names in its style."""


def families() -> list[str]:
    """The fonts of this machine in which matplotlib looks for letters, in this order."""
    here = set(font_manager.get_font_names())
    return ["DejaVu Sans", *(name for name in _CJK if name in here)]


RC: dict[Any, Any] = {
    "figure.constrained_layout.use": True,
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor"), INK),
    **dict.fromkeys(("xtick.color", "ytick.color", "hatch.color"), INK),
    # A name from a recording is never TeX, even with dollar signs.
    "text.parse_math": False,
    # Without this the ids inside an SVG are random.
    "svg.hashsalt": "pipeline",
    # Only fonts that exist: matplotlib warns of every other.
    "font.family": families(),
    "axes.titlesize": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GRID,
    "axes.axisbelow": True,
    "legend.frameon": False,
}


def write(folder: Path, pictures: Mapping[str, Callable[[], Figure]]) -> list[Path]:
    """Draw each picture in the common style, save it by its name and return the paths."""
    with mpl.rc_context(RC):
        for name, draw in pictures.items():
            # Without its `Software` entry the file does not change with matplotlib's version.
            draw().savefig(folder / name, dpi=120, metadata={"Software": None})
    return [folder / name for name in pictures]


def canvas(width: float, height: float) -> Figure:
    """An empty picture of this size in inches."""
    return Figure(figsize=(width, height))


def panels(width: float, height: float, *grid: int, **options: Any) -> tuple[Figure, Any]:
    """An empty picture of this size in inches and its panels, as `Figure.subplots` gives them."""
    figure = canvas(width, height)
    return figure, figure.subplots(*grid, **options)


def draw_frame(axis: Axes, frame: NDArray[np.uint8]) -> None:
    """A frame (height, width, 3) RGB without ticks and grid."""
    axis.imshow(frame)
    axis.set(xticks=[], yticks=[])
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)


def shorten_middle(name: str, begin: int, end: int) -> str:
    """A name without its middle, if it is longer than both ends."""
    return name if len(name) <= begin + end + 1 else f"{name[:begin]}…{name[-end:]}"


def draw_strip(
    figure: Figure,
    grid: GridSpec,
    frames: Mapping[str, Sequence[NDArray[np.uint8]]],
    times_s: Sequence[float],
) -> None:
    """Draw the frames of each view as a row of `grid`, from the first row, below their times."""
    for row, (view, images) in enumerate(frames.items()):
        for column, image in enumerate(images):
            axis = figure.add_subplot(grid[row, column])
            draw_frame(axis, image)
            # Matplotlib names an image by its content, which may come twice.
            axis.images[0].set_gid(f"frame-{row}-{column}")
            axis.set_ylabel("" if column else view)
            axis.set_title("" if row else f"{times_s[column]:.1f} s")


def finish(figure: Figure, axis: Axes, columns: int, title: str | None = None) -> None:
    """Draw the legend of one axis below all panels, and a title above them."""
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns)
    if title is not None:
        figure.suptitle(title)


def inline_svg(figure: Figure, name: str, label: str) -> str:
    """One `<svg>` element of `figure`; the same figure gives the same bytes.

    Text stays text in the page's font, neutral colours become the page's, the background is
    transparent, and images are data URIs (photographs as JPEG). Every id begins with `name`, so
    that one page can hold several pictures. `label` is for screen readers.
    """
    written = io.StringIO()
    # Matplotlib makes ids of clips and markers from their content and this salt.
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name, "svg.image_inline": True}):
        figure.savefig(written, format="svg", dpi=RASTER_DPI, transparent=True, metadata=_NONE)
    body = re.sub(r"^.*?<svg[^>]*>|</svg>\s*$", "", written.getvalue(), flags=re.DOTALL)
    width, height = POINTS_INCH * figure.get_size_inches()
    # No wider than it was drawn. Shapes without a colour, black in SVG, get the page's ink.
    return (
        f'<svg viewBox="0 0 {width:g} {height:g}" xmlns:xlink="http://www.w3.org/1999/xlink" '
        f'fill="currentColor" style="--w:{width * POINT_PX:.0f};--h:{height * POINT_PX:.0f}" '
        f'role="img" aria-label="{escape(label)}"><title>{escape(label)}</title>'
        f"{_body(body, name)}</svg>"
    )


def _body(body: str, name: str) -> str:
    body = re.sub(r"<metadata>.*?</metadata>\s*", "", body, count=1, flags=re.DOTALL)
    body = re.sub(r'(?<=\sid=")(?=[^"])', f"{name}-", body)
    body = re.sub(r'(?<=href="#)', f"{name}-", body)
    body = re.sub(r"(?<=url\(#)", f"{name}-", body)
    body = re.sub(r"'DejaVu Sans'[^;\"]*", FONTS, body)
    for colour, name in COLOURS.items():
        body = re.sub(rf"{colour}(?![0-9a-f])", f"var(--{name})", body, flags=re.IGNORECASE)
    return re.sub(r"data:image/png;base64,([^\"]+)", _smaller, body)


def _smaller(image: re.Match[str]) -> str:
    """A camera's frame as JPEG; curves, maps and partly transparent images unchanged."""
    png = base64.b64decode(image[1])
    with Image.open(io.BytesIO(png)) as decoded:
        alpha = decoded.getchannel("A").getextrema() if "A" in decoded.getbands() else (255, 255)
        if len(png) < PHOTO_BYTES or alpha != (255, 255):
            return image[0]
        written = io.BytesIO()
        decoded.convert("RGB").save(written, "JPEG", quality=PHOTO_QUALITY, subsampling=0)
    jpeg = written.getvalue()
    if len(jpeg) * PHOTO_RATIO > len(png):
        return image[0]
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}"
