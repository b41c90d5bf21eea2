"""A small canvas for explaining figures: SVG whose colours are names, light and dark.

Text stays text, so that it can be searched, read aloud and set in the page's own font. On its own a
drawing follows the system's light or dark; in the site it follows the page, which names the same
colours in `site.css`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from xml.sax.saxutils import escape

Point = tuple[float, float]

LIGHT = {
    "ink": "#1f2328",
    "mute": "#656d76",
    "faint": "#d0d7de",
    "paper": "#ffffff",
    "frame": "#0072b2",
    "vl": "#8250b4",
    "sensor": "#c2410c",
    "state": "#00806a",
    "action": "#b0266f",
}
DARK = {
    "ink": "#e6e9ee",
    "mute": "#9aa4b0",
    "faint": "#454c57",
    "paper": "#0d1117",
    "frame": "#4fb3f0",
    "vl": "#bd95f2",
    "sensor": "#f5925a",
    "state": "#37c9a8",
    "action": "#f27db3",
}
"""One colour a kind of thing, in every figure: frames, VL rows, sensor, state, actions."""

FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"
MONO = "ui-monospace, SFMono-Regular, Menlo, Consolas, 'DejaVu Sans Mono', monospace"


@dataclass
class Drawing:
    """A figure of this size in pixels of its own; `title` is what a screen reader says."""

    width: int
    height: int
    title: str
    parts: list[str] = field(default_factory=list)

    def box(
        self,
        x: float,
        y: float,
        width: float,
        height: float,
        colour: str = "ink",
        *,
        fill: float = 0.0,
        line: float = 1.5,
        dash: str = "",
        radius: float = 4,
    ) -> None:
        """A rectangle: its outline in a colour, its inside in as much of the same colour."""
        style = f"stroke:var(--{colour});stroke-width:{line:g};fill:var(--{colour})"
        dashes = f";stroke-dasharray:{dash}" if dash else ""
        self.parts.append(
            f'<rect x="{_n(x)}" y="{_n(y)}" width="{_n(width)}" height="{_n(height)}" '
            f'rx="{radius:g}" style="{style};fill-opacity:{fill:g}{dashes}"/>'
        )

    def line(self, *points: Point, colour: str = "ink", width: float = 1.5, dash: str = "") -> None:
        """A line through points."""
        self._stroke(_through(points), colour, width, dash)

    def arrow(self, *points: Point, colour: str = "mute", width: float = 1.5) -> None:
        """A line through points with a head at its end."""
        (x0, y0), (x1, y1) = points[-2:]
        length = max(1e-9, ((x1 - x0) ** 2 + (y1 - y0) ** 2) ** 0.5)
        along, across = (
            ((x1 - x0) / length, (y1 - y0) / length),
            (-(y1 - y0) / length, (x1 - x0) / length),
        )
        size = 5 + 2 * width
        back = (x1 - size * along[0], y1 - size * along[1])
        self._stroke(_through([*points[:-1], back]), colour, width)
        half = size * 0.42
        head = [
            (x1, y1),
            (back[0] + half * across[0], back[1] + half * across[1]),
            (back[0] - half * across[0], back[1] - half * across[1]),
        ]
        self.parts.append(f'<path d="{_through(head)}Z" style="fill:var(--{colour})"/>')

    def curve(self, path: str, colour: str = "ink", width: float = 1.5) -> None:
        """A stroke along a path in SVG's notation."""
        self._stroke(path, colour, width)

    def dot(
        self, x: float, y: float, radius: float, colour: str = "ink", *, fill: float = 1
    ) -> None:
        """A circle, full or only its outline."""
        self.parts.append(
            f'<circle cx="{_n(x)}" cy="{_n(y)}" r="{radius:g}" style="stroke:var(--{colour});'
            f'stroke-width:1.5;fill:var(--{colour});fill-opacity:{fill:g}"/>'
        )

    def text(
        self,
        x: float,
        y: float,
        said: str | Sequence[str],
        colour: str = "ink",
        *,
        size: float = 14,
        anchor: str = "start",
        bold: bool = False,
        mono: bool = False,
        halo: bool = False,
        turned: bool = False,
    ) -> None:
        """Lines of text, the first one's foot at y; a halo keeps them apart from lines behind."""
        style = f"fill:var(--{colour})"
        style += ";font-weight:600" if bold else ""
        style += f";font-family:{MONO}" if mono else ""
        style += (
            ";paint-order:stroke;stroke:var(--paper);stroke-width:4;stroke-linejoin:round"
            if halo
            else ""
        )
        for row, one in enumerate([said] if isinstance(said, str) else said):
            turn = f' transform="rotate(-90 {_n(x)} {_n(y)})"' if turned else ""
            self.parts.append(
                f'<text x="{_n(x)}" y="{_n(y + row * size * 1.3)}" font-size="{size:g}" '
                f'text-anchor="{anchor}"{turn} style="{style}">{escape(one)}</text>'
            )

    def hatch(self, x: float, y: float, width: float, height: float, colour: str = "mute") -> None:
        """A field of slanted lines: what is not there."""
        self.box(x, y, width, height, colour, line=1, dash="3 3", radius=2)
        step = 7.0
        offset = step
        while offset < width + height:
            begin = (x + max(0.0, offset - height), y + min(offset, height))
            end = (x + min(offset, width), y + max(0.0, offset - width))
            self._stroke(_through([begin, end]), colour, 0.8)
            offset += step

    def svg(self, colours: Mapping[str, str] | None = None) -> str:
        """The document; with `colours` in those alone, else light or dark as the system is."""
        names = ";".join(f"--{name}:{value}" for name, value in (colours or LIGHT).items())
        dark = ";".join(f"--{name}:{value}" for name, value in DARK.items())
        rules = f".drawn{{{names}}}"
        if colours is None:
            rules += f"@media(prefers-color-scheme:dark){{.drawn{{{dark}}}}}"
        rules += f".drawn{{font-family:{FONT}}}"
        body = "\n".join(self.parts)
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" class="drawn" role="img" '
            f'width="{self.width}" height="{self.height}" '
            f'viewBox="0 0 {self.width} {self.height}">\n'
            f"<title>{escape(self.title)}</title>\n<style>{rules}</style>\n{body}\n</svg>\n"
        )

    def _stroke(self, path: str, colour: str, width: float, dash: str = "") -> None:
        dashes = f";stroke-dasharray:{dash}" if dash else ""
        self.parts.append(
            f'<path d="{path}" style="fill:none;stroke:var(--{colour});stroke-width:{width:g}'
            f';stroke-linejoin:round;stroke-linecap:round{dashes}"/>'
        )


def _through(points: Sequence[Point]) -> str:
    return "M" + "L".join(f"{_n(x)} {_n(y)}" for x, y in points)


def _n(value: float) -> str:
    return f"{value:.1f}".removesuffix(".0")
