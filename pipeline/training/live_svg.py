"""A curve over steps as a small SVG: axes, a line, its newest and its lowest value."""

import math
from collections.abc import Sequence
from html import escape

WIDTH, HEIGHT = 340, 180
LEFT, RIGHT, TOP, BOTTOM = 46, 10, 8, 22
MOST_POINTS = 300
"""Points drawn of a curve; of a longer one each is the mean of its neighbours."""
LOG_FROM = 20
"""A curve of positive values whose largest is so many times its smallest has a logarithmic axis."""
_FIRST = ("val/error", "train/loss")

Point = tuple[float, float]


class Curve:
    """Values of a metric at steps."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.steps: list[int] = []
        self.values: list[float] = []

    @property
    def rank(self) -> tuple[bool, str]:
        """Sorts what is looked at first before the rest, which goes by name."""
        return self.name not in _FIRST, self.name

    def add(self, step: int, value: float) -> None:
        """Add the value at a step; one that is not a number ends the line there."""
        self.steps.append(step)
        self.values.append(value)

    def points(self) -> list[Point]:
        """At most `MOST_POINTS` (step, value), of finite values."""
        found = [
            (float(step), value)
            for step, value in zip(self.steps, self.values, strict=True)
            if math.isfinite(value)
        ]
        share = -(-len(found) // MOST_POINTS)
        if share <= 1:
            return found
        groups = [found[first : first + share] for first in range(0, len(found), share)]
        return [(_mean([p[0] for p in group]), _mean([p[1] for p in group])) for group in groups]


def chart(curve: Curve) -> str:
    """The curve as an HTML figure with its newest and its lowest value in words."""
    points = curve.points()
    name = escape(curve.name)
    if not points:
        return f"<figure><figcaption><b>{name}</b> no finite value yet</figcaption></figure>"
    low = min(range(len(points)), key=lambda at: points[at][1])
    said = f"{points[-1][1]:.4g} at step {points[-1][0]:,.0f}"
    if curve.name.startswith("val/"):
        said += f", lowest {points[low][1]:.4g} at {points[low][0]:,.0f}"
    drawn, axis = _drawn(curve, points, low)
    return (
        f"<figure><figcaption><b>{name}</b> {said}{axis}</figcaption>\n"
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{name}: {said}">{drawn}</svg>'
        "</figure>"
    )


def _drawn(curve: Curve, points: Sequence[Point], low: int) -> tuple[str, str]:
    values = [value for _, value in points]
    log = min(values) > 0 and max(values) > LOG_FROM * min(values)
    scaled = [math.log10(value) if log else value for value in values]
    down, up = _padded(min(scaled), max(scaled))
    first, last = points[0][0], max(points[-1][0], points[0][0] + 1)

    def x(step: float) -> float:
        return LEFT + (step - first) / (last - first) * (WIDTH - LEFT - RIGHT)

    def y(value: float) -> float:
        return TOP + (up - value) / (up - down) * (HEIGHT - TOP - BOTTOM)

    lines = [_rule(y(math.log10(t) if log else t), t) for t in _ticks(down, up, log)]
    for tick in (t for t in nice_ticks(first, last, 4) if t == round(t)):
        lines.append(
            f'<text x="{x(tick):.1f}" y="{HEIGHT - 6}" text-anchor="middle">{_k(tick)}</text>'
        )
    line = " ".join(
        f"{x(step):.1f},{y(value):.1f}" for (step, _), value in zip(points, scaled, strict=True)
    )
    lines.append(
        f'<polyline points="{line}" fill="none" stroke="var(--line)" stroke-width="1.6" '
        'stroke-linejoin="round"/>'
    )
    if curve.name.startswith("val/") or len(points) == 1:
        lines.append(
            f'<circle cx="{x(points[low][0]):.1f}" cy="{y(scaled[low]):.1f}" r="3.2" '
            'fill="var(--line)"/>'
        )
    return "".join(lines), ", logarithmic" if log else ""


def _rule(height: float, value: float) -> str:
    return (
        f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{height:.1f}" y2="{height:.1f}" '
        f'stroke="var(--grid)"/><text x="{LEFT - 5}" y="{height + 3.5:.1f}" '
        f'text-anchor="end">{value:.3g}</text>'
    )


def _ticks(down: float, up: float, log: bool) -> list[float]:
    if not log:
        return nice_ticks(down, up, 4)
    decades = range(math.floor(down), math.ceil(up) + 1)
    inside = [m * 10.0**d for d in decades for m in (1, 2, 5) if down <= math.log10(m) + d <= up]
    # Decades alone where there are many.
    return inside if len(inside) <= 6 else [t for t in inside if f"{t:e}"[0] == "1"]


def nice_ticks(low: float, high: float, count: int) -> list[float]:
    """Multiples of 1, 2 or 5 times a power of ten within [low, high], about `count` of them."""
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= 0.7 * raw)
    first = math.ceil(low / step - 1e-9)
    return [n * step for n in range(first, math.floor(high / step + 1e-9) + 1)]


def _padded(low: float, high: float) -> tuple[float, float]:
    spread = (high - low) or abs(high) or 1.0
    return low - 0.05 * spread, high + 0.05 * spread


def _k(step: float) -> str:
    return f"{step / 1e6:g}M" if step >= 1e6 else f"{step / 1e3:g}k" if step >= 1e4 else f"{step:g}"


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)
