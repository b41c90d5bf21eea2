"""The curves of a run as one page that draws itself again while the run goes.

dvclive's own HTML report fetches its drawing library from the network and is blank without; this
page has its curves in it as SVG and asks for nothing. It knows no drawing library, so that DVC does
not train again for a change in one of them, and costs milliseconds.
"""

import time
from collections.abc import Mapping
from html import escape
from pathlib import Path

from pipeline.training.live_svg import Curve, chart

PAGE = "report.html"
REFRESH_S = 5
"""How often the page is written at most, and how often a browser looks again."""
COST = 1 / 200
"""Largest share of a run's time that drawing takes: after a page that took long, it waits."""

_STYLE = """
:root{color-scheme:light dark;--ink:#1f2328;--soft:#5f6b76;--grid:#e3e6ea;--line:#0072b2;
--card:#fff;--back:#f6f7f9}
@media (prefers-color-scheme:dark){:root{--ink:#e6e9ec;--soft:#9aa6b2;--grid:#353b42;
--line:#56b4e9;--card:#1b1f24;--back:#121518}}
body{margin:0 auto;max-width:76rem;padding:1rem;background:var(--back);color:var(--ink);
font:15px/1.45 system-ui,sans-serif}
h1{font-size:1.25rem;margin:.2rem 0;overflow-wrap:anywhere}h2{font-size:1rem;margin:1.2rem 0 .5rem}
p{margin:.2rem 0;color:var(--soft)}progress{width:100%;height:.6rem;accent-color:var(--line)}
main{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,21rem),1fr));gap:.8rem}
figure{margin:0;padding:.6rem .7rem;background:var(--card);border:1px solid var(--grid);
border-radius:6px}
figcaption{font-size:.85rem;color:var(--soft)}figcaption b{display:block;color:var(--ink);
font-size:.95rem}
svg{display:block;width:100%;height:auto}svg text{fill:var(--soft);font-size:10px}
"""
_SECTIONS = (("val/", "Held-out ticks"), ("train/", "Training"), ("", "Schedule"))


class LivePage:
    """A `Logger` that keeps `<folder>/report.html` up to date.

    While the run goes a browser draws the page again every `REFRESH_S` seconds. The same numbers
    give the same bytes, for DVC hashes the folder.
    """

    def __init__(self, folder: Path, title: str, last_step: int) -> None:
        self._path, self._title, self._last_step = folder / PAGE, title, last_step
        self._curves: dict[str, Curve] = {}
        self._step = 0
        self._due = 0.0

    @property
    def note(self) -> str:
        """Where to look."""
        return f"live: open {self._path} in a browser"

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Take in a row; write the page where it is due."""
        self._step = step
        for name, value in metrics.items():
            self._curves.setdefault(name, Curve(name)).add(step, value)
        began = time.monotonic()
        if began >= self._due:
            self._save("training", f'<meta http-equiv="refresh" content="{REFRESH_S}">')
            drawn = time.monotonic()
            self._due = drawn + max(REFRESH_S, (drawn - began) / COST)

    def close(self, finished: bool) -> None:
        """Write the page as it stays: of a run that is finished, or stopped."""
        self._save("finished" if finished else "stopped; the same command goes on", "")

    def _save(self, state: str, refresh: str) -> None:
        # Renamed into place: a browser never reads half a page.
        temporary = self._path.with_name(f"{PAGE}.new")
        temporary.write_text(self._html(state, refresh), encoding="utf-8")
        temporary.rename(self._path)

    def _html(self, state: str, refresh: str) -> str:
        parts: list[str] = []
        left = sorted(self._curves.values(), key=lambda curve: curve.rank)
        for prefix, heading in _SECTIONS:
            here = [curve for curve in left if curve.name.startswith(prefix)]
            left = [curve for curve in left if curve not in here]
            if here:
                charts = "\n".join(chart(curve) for curve in here)
                parts.append(f"<h2>{heading}</h2>\n<main>\n{charts}\n</main>")
        title, body = escape(self._title), "\n".join(parts)
        return (
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width,initial-scale=1">\n'
            f"{refresh}<title>{title}</title><style>{_STYLE}</style></head><body>\n"
            f"<h1>{title}</h1>\n<p>step {self._step:,} of {self._last_step:,}, {state}</p>\n"
            f'<progress max="{self._last_step}" value="{self._step}" aria-label="steps"></progress>'
            f"\n{body}\n</body></html>\n"
        )
