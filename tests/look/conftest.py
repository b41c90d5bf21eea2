"""What a browser must find of a page, and a report with every kind of block."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from playwright.sync_api import Browser, Page, Route

from pipeline.base.errors import Issue
from pipeline.base.text import Table
from pipeline.look.page.blocks import (
    Issues,
    Outline,
    Picture,
    Report,
    Section,
    Text,
    TokenRun,
    Tokens,
)
from pipeline.look.page.style import GRID, INK, canvas
from pipeline.look.page.writing import write_report

WIDE, DESKTOP, PHONE = (1920, 1080), (1280, 900), (390, 844)


@dataclass
class Visit:
    """A loaded page and what it did that a page must not."""

    page: Page
    trouble: list[str] = field(default_factory=list)


Visitor = Callable[..., Visit]


@pytest.fixture
def browser_page(browser: Browser) -> Iterator[Visitor]:
    """`browser_page(path, size=…, scheme=…, script=…, **context)` loads a page from its file.

    `script` runs before the page's own.
    """
    contexts = []

    def visit(
        path: Path,
        size: tuple[int, int] = DESKTOP,
        scheme: str = "light",
        script: str = "",
        **options: Any,
    ) -> Visit:
        viewport = {"width": size[0], "height": size[1]}
        context = browser.new_context(viewport=viewport, color_scheme=scheme, **options)
        contexts.append(context)
        context.add_init_script(script)
        page = context.new_page()
        visit = Visit(page)
        address = path.resolve().as_uri()

        def guard(route: Route) -> None:
            url = route.request.url
            if url.split("#")[0] == address or url.startswith(("data:", "blob:")):
                route.continue_()
            else:
                visit.trouble.append(f"request for {url}")
                route.abort()

        context.route("**/*", guard)
        page.on(
            "console",
            lambda said: visit.trouble.append(said.text) if said.type == "error" else None,
        )
        page.on("pageerror", lambda error: visit.trouble.append(f"script: {error}"))
        page.goto(address)
        return visit

    yield visit
    for context in contexts:
        context.close()


LOOK = """() => {
  const box = (element) => element.getBoundingClientRect();
  const seen = (element) => box(element).width > 40 && box(element).height > 20;
  const named = (list) => [...list].map((one) => one.closest("figure").id);
  const luminance = (colour) => {
    const [r, g, b] = colour.match(/[0-9.]+/g).map((part) => {
      const share = part / 255;
      return share <= 0.04045 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4;
    });
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const behind = (element) => {
    const colour = getComputedStyle(element).backgroundColor;
    return colour.endsWith(", 0)") ? behind(element.parentElement) : colour;
  };
  const contrast = (element) => {
    const both = [getComputedStyle(element).color, behind(element)].map(luminance);
    return (Math.max(...both) + 0.05) / (Math.min(...both) + 0.05);
  };
  const said = [...document.querySelectorAll("body *:not(svg *, script)")]
    .filter((one) => [...one.childNodes].some((node) => node.nodeType === 3 && node.data.trim()));
  const ids = [...document.querySelectorAll("[id]")].map((one) => one.id);
  const pictures = [...document.querySelectorAll("figure .wide > svg")];
  return {
    overflow: document.documentElement.scrollWidth - window.innerWidth,
    pictures: pictures.length,
    cut: [...document.querySelectorAll("table")].filter((table) => {
      const [first, second] = table.rows[0].cells;
      return box(second ?? first).left > innerWidth - 20;
    }).map((table) => table.textContent.trim().slice(0, 60)),
    unseen: named(pictures.filter((svg) => !seen(svg))),
    faint: said.filter((one) => contrast(one) < 4.5).map((one) => one.outerHTML.slice(0, 90)),
    unnamed: named(pictures.filter((svg) => !svg.querySelector(":scope > title")?.textContent)),
    dead: [...document.querySelectorAll('a[href^="#"]')]
      .map((link) => link.getAttribute("href").slice(1))
      .filter((id) => !document.getElementById(id)),
    links: document.querySelectorAll("nav a").length,
    twice: ids.filter((id, index) => ids.indexOf(id) !== index),
    paper: luminance(getComputedStyle(document.body).backgroundColor),
    inks: pictures.map((svg) => luminance(getComputedStyle(svg).fill)),
  };
}"""


@pytest.fixture
def assert_page_is_sound(browser_page: Visitor) -> Callable[[Path], None]:
    """`assert_page_is_sound(path)`: at three widths, and at two of them in light and in dark.

    Nothing errs, no request leaves the page, nothing overflows, what a table says first can be seen
    without scrolling sideways, every picture is there in an
    ink that contrasts, words contrast as WCAG's AA wants, every link of the contents leads
    somewhere, and no id is there twice. Each width is loaded in one scheme and goes over to the
    other as a system does at dusk.
    """

    def check(path: Path) -> None:
        both = ((DESKTOP, ("light", "dark")), (PHONE, ("dark", "light")))
        for size, schemes in ((WIDE, ("light",)), *both):
            visit = browser_page(path, size, schemes[0])
            for scheme in schemes:
                visit.page.emulate_media(color_scheme=scheme)
                found, here = visit.page.evaluate(LOOK), f"{path.name} at {size}, {scheme}"
                assert visit.trouble == [], here
                assert found["overflow"] <= 0, here
                assert found["links"] > 0, here
                for wrong in ("cut", "unseen", "unnamed", "faint", "dead", "twice"):
                    assert found[wrong] == [], f"{here}: {wrong}"
                paper, inks = found["paper"], found["inks"]
                if scheme == "light":
                    assert paper > 0.9 and all(ink < 0.1 for ink in inks), (here, found)
                else:
                    assert paper < 0.05 and all(ink > 0.5 for ink in inks), (here, found)

    return check


def drawn() -> Figure:
    """A picture with a line, an image, a clip path and neutral colours."""
    figure = canvas(12, 3)
    left, right = figure.subplots(1, 2)
    left.plot(np.sin(np.arange(50) / 9), color="#0072B2", label="a sine")
    left.plot([0, 50], [0, 0], color=INK)
    left.axvspan(3, 5, color=GRID)
    left.set_xlabel("time [s]")
    left.legend()
    right.imshow(np.arange(80.0).reshape(8, 10))
    return figure


@pytest.fixture(scope="session")
def every_block() -> Report:
    """A report with every kind of block, and with texts that try to break out."""
    long = "a/" + "x" * 200
    issues = [
        Issue(severity="warning", kind=f"kind {kind}", message="n", episode=long, stream="sensor")
        for kind in range(14)
    ]
    broken = "`x.jpg` is no picture <script>"
    issues.append(Issue(severity="error", kind="unreadable", message=broken, episode="b"))
    return Report(
        "A page <of> every block",
        f"Of `{long}`.",
        [("episodes", "12"), ("length", "1,204 s"), ("store", long)],
        [
            Section(
                "Words",
                [
                    Text("With `code` & <script>alert(1)</script>."),
                    Table(
                        ["episode", "ticks", "mean [N]", "good"],
                        [[long, 12000, 1.23456, True], ["b", 3, float("nan"), None]],
                        "A table",
                        frozenset({1}),
                    ),
                    Issues(issues, "fine"),
                    Issues([], "Nothing looks wrong."),
                ],
            ),
            Section(
                "Pictures",
                [Picture("one", "A sine & an image.", drawn), Picture("two", "Again.", drawn)],
                [Section("Words", [Text("again")])],
            ),
            Section(
                "Prompt",
                [
                    Tokens(
                        [
                            TokenRun("<|im_start|>", "special"),
                            TokenRun("user\ntouch <b>", "text"),
                            TokenRun("<|image_pad|>", "image", "48 tokens"),
                        ]
                    ),
                    Outline("Spec", {"weights": "w" * 300, "slots": [{"layer": -1}], "x": {}}),
                ],
            ),
        ],
    )


@pytest.fixture(scope="session")
def every_page(every_block: Report, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its page, not to be written to; beside it what comes with it."""
    return write_report(tmp_path_factory.mktemp("every"), every_block)[0]
