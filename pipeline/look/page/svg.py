"""A matplotlib figure -> SVG inside a page: transparent, in the page's ink, with no other file."""

import base64
import io
import re

import matplotlib as mpl
from markupsafe import escape
from matplotlib.figure import Figure
from PIL import Image

from pipeline.look.page.style import GRID, INK, PALETTE

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
