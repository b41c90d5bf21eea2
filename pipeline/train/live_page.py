"""The curves of a run as one page that draws itself again while the run goes.

It has its curves in it as SVG and asks for nothing, unlike dvclive's report, which fetches its
drawing library from the network. It knows no drawing library, so that DVC does not train again for
a change in one of them.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from statistics import fmean

PAGE = "report.html"
REFRESH_S = 5
"""How often a page is written at most, and how often a browser looks again."""
COST = 1 / 200
"""Largest share of a run's time that drawing takes: after a page that took long, it waits."""
MOST_POINTS = 300
"""Points drawn of a curve; of a longer one each is the mean of its neighbours."""
LOG_FROM = 20
"""A curve of positive values whose largest is so many times its smallest has a logarithmic axis."""
WIDTH, HEIGHT = 340, 180
LEFT, RIGHT, TOP, BOTTOM = 60, 10, 8, 22

_SECTIONS = (
    (
        "val/",
        "Held-out ticks",
        "Mean absolute errors: val/error over the action dimensions that vary, each in its "
        "training std; the others of a group of dimensions, in its own unit. Of these, other holds "
        "what is neither translation, rotation nor gripper, such as velocities.",
    ),
    (
        "train/",
        "Training",
        "Each point is the mean over the steps since the point before it; the terminal says the "
        "loss of one step.",
    ),
    ("", "Schedule", ""),
)
"""Prefix of the curves, heading, and what a reader has to know of them."""
_FIRST = ("val/error", "train/loss")
_UNITS = {"val/error": "training std"}
"""Of curves whose name has none."""
_STYLE = """
:root{color-scheme:light dark;--ink:#24272b;--soft:#62676e;--grid:#dcdcd8;--line:#0072b2;
--card:#f4f4f1;--back:#fdfdfc}
@media (prefers-color-scheme:dark){:root{--ink:#dfe1e4;--soft:#9aa1a9;--grid:#353a40;
--line:#2a8fd4;--card:#1f2226;--back:#16181b}}
body{margin:0 auto;max-width:76rem;padding:1rem;background:var(--back);color:var(--ink);
font:15px/1.45 system-ui,sans-serif}
h1{font-size:1.25rem;margin:.2rem 0;overflow-wrap:anywhere}h2{font-size:1rem;margin:1.2rem 0 .5rem}
h2+p{font-size:.85rem;max-width:72ch;padding-bottom:.4rem}
p{margin:.2rem 0;color:var(--soft)}progress{width:100%;height:.6rem;accent-color:var(--line)}
main{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,21rem),1fr));gap:.8rem}
figure{margin:0;padding:.6rem .7rem;background:var(--card);border:1px solid var(--grid);
border-radius:6px}
figcaption{font-size:.85rem;color:var(--soft)}figcaption b{display:block;color:var(--ink);
font-size:.95rem}
svg{display:block;width:100%;height:auto;stroke:var(--grid);fill:none}
svg text{fill:var(--soft);stroke:none;font-size:10px}
polyline{stroke:var(--line);stroke-width:1.6;stroke-linejoin:round}
circle{fill:var(--line);stroke:none}
"""

Point = tuple[float, float]
"""A step and a value."""


class Turns:
    """Says when a page is due: every `REFRESH_S`, or later where drawing takes more than `COST`."""

    def __init__(self) -> None:
        self._due = -math.inf

    def take(self, draw: Callable[[], None]) -> None:
        """Draw, if it is time."""
        began = time.monotonic()
        if began >= self._due:
            draw()
            drawn = time.monotonic()
            self._due = drawn + max(REFRESH_S, (drawn - began) / COST)


class LivePage:
    """A `Logger` that keeps `<folder>/report.html` up to date.

    While the run goes the page says when it was written and is loaded again every `REFRESH_S`
    seconds. At its end the same numbers give the same bytes, for DVC hashes the folder.
    """

    def __init__(self, folder: Path, title: str, last_step: int) -> None:
        self._path, self._title, self._last_step = folder / PAGE, title, last_step
        self._curves: dict[str, list[Point]] = {}
        self._step = 0
        self._turns = Turns()

    @property
    def note(self) -> str:
        """Where to look."""
        return f"live: open {self._path} in a browser"

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Take in a row, of which what is not finite is not drawn; write the page if it is due."""
        self._step = step
        for name, value in metrics.items():
            points = self._curves.setdefault(name, [])
            if math.isfinite(value):
                points.append((step, value))
        self._turns.take(self._save_running)

    def close(self, finished: bool) -> None:
        """Write the page as it stays: of a run that is finished, or stopped."""
        self._save("finished" if finished else "stopped before its end; the terminal says why")

    def _save_running(self) -> None:
        written = time.strftime("%Y-%m-%d %H:%M:%S %Z")
        self._save(
            f"training. Written {written}; if that is long ago, the run was killed, and the same "
            "command goes on",
            f'<meta http-equiv="refresh" content="{REFRESH_S}">',
        )

    def _save(self, state: str, refresh: str = "") -> None:
        # Renamed into place: a browser never reads half a page.
        temporary = self._path.with_name(f"{PAGE}.new")
        temporary.write_text(self._html(state, refresh), encoding="utf-8")
        temporary.rename(self._path)

    def _html(self, state: str, refresh: str) -> str:
        parts: list[str] = []
        left = sorted(self._curves, key=lambda name: (name not in _FIRST, name))
        for prefix, heading, words in _SECTIONS:
            here = [name for name in left if name.startswith(prefix)]
            left = [name for name in left if name not in here]
            told = f"<p>{words}</p>\n" if words else ""
            if here:
                charts = "\n".join(chart(name, self._curves[name]) for name in here)
                parts.append(f"<h2>{heading}</h2>\n{told}<main>\n{charts}\n</main>")
        title, body = escape(self._title), "\n".join(parts)
        return (
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width,initial-scale=1">\n'
            f"{refresh}<title>{title}</title><style>{_STYLE}</style></head><body>\n"
            f"<h1>{title}</h1>\n<p>step {self._step:,} of {self._last_step:,}, {state}</p>\n"
            f'<progress max="{self._last_step}" value="{self._step}" aria-label="steps"></progress>'
            f"\n{body}\n</body></html>\n"
        )


def chart(name: str, points: Sequence[Point]) -> str:
    """A curve as an HTML figure, with its newest and, of an error, its lowest value in words."""
    title = escape(f"{name} [{_UNITS[name]}]" if name in _UNITS else name)
    if not points:
        return f"<figure><figcaption><b>{title}</b> no finite value yet</figcaption></figure>"
    judged = name.startswith("val/")
    step, value = points[-1]
    said = f"{value:.4g} at step {step:,}"
    if judged:
        step, value = min(points, key=lambda point: point[1])
        said += f", lowest {value:.4g} at {step:,}"
    line = thinned(points)
    values = [value for _, value in line]
    log = 0 < LOG_FROM * min(values) < max(values)
    return (
        f"<figure><figcaption><b>{title}</b> {said}{', logarithmic' if log else ''}</figcaption>\n"
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{title}: {said}">'
        f"{_drawn(line, log, marked=judged or len(line) == 1)}</svg></figure>"
    )


def thinned(points: Sequence[Point]) -> list[Point]:
    """At most `MOST_POINTS`, each the mean of as many neighbours."""
    share = math.ceil(len(points) / MOST_POINTS)
    groups = (points[first : first + share] for first in range(0, len(points), share))
    return [(fmean(s for s, _ in group), fmean(v for _, v in group)) for group in groups]


def _drawn(points: Sequence[Point], log: bool, marked: bool) -> str:
    """The line, four levels and three steps to read it by, and a mark at its lowest point."""
    scaled = [(step, math.log10(value) if log else value) for step, value in points]
    down, up = min(v for _, v in scaled), max(v for _, v in scaled)
    if down == up:
        down, up = down - (abs(down) or 1), up + (abs(up) or 1)
    first, last = points[0][0], max(points[-1][0], points[0][0] + 1)

    def place(step: float, value: float) -> tuple[str, str]:
        x = LEFT + (step - first) / (last - first) * (WIDTH - LEFT - RIGHT)
        y = TOP + (up - value) / (up - down) * (HEIGHT - TOP - BOTTOM)
        return f"{x:.1f}", f"{y:.1f}"

    parts: list[str] = []
    for level in (down + share * (up - down) / 3 for share in range(4)):
        y = place(first, level)[1]
        parts.append(
            f'<path d="M{LEFT} {y}H{WIDTH - RIGHT}"/><text x="{LEFT - 5}" y="{y}" dy=".35em" '
            f'text-anchor="end">{10**level if log else level:.4g}</text>'
        )
    for step, anchor in ((first, "start"), ((first + last) / 2, "middle"), (last, "end")):
        x = place(step, down)[0]
        parts.append(f'<text x="{x}" y="{HEIGHT - 6}" text-anchor="{anchor}">{step:,.0f}</text>')
    parts.append(f'<polyline points="{" ".join(",".join(place(*one)) for one in scaled)}"/>')
    if marked:
        x, y = place(*min(scaled, key=lambda point: point[1]))
        parts.append(f'<circle cx="{x}" cy="{y}" r="3.2"/>')
    return "".join(parts)
