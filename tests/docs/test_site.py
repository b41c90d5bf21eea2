"""The built site in a real browser, from a folder: no errors, no other host."""

import re
from contextlib import closing
from html.parser import HTMLParser
from pathlib import Path

import pytest

pytestmark = pytest.mark.extra
DESKTOP, PHONE = (1280, 900), (390, 844)
PAGES = ("index", "params", "data/errors")
MORE = ("concepts", "store", "reference/store")


class Links(HTMLParser):
    """Where a page's links and resources lead, and which anchors it has."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.anchors: set[str] = set()
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = dict(attrs)
        self.anchors |= {value for name, value in attrs if name in ("id", "name") and value}
        self.targets += [value for name in ("href", "src") if (value := named.get(name))]


def test_every_link_and_anchor_is_there(site):
    pages = {path: Links(path) for path in site.rglob("*.html") if path.name != "404.html"}
    assert len(pages) >= 35
    lost = []
    for page, links in pages.items():
        for target in links.targets:
            if re.match(r"[a-z]+:", target):
                continue
            name, _, anchor = target.partition("#")
            place = (page.parent / name).resolve() if name else page
            if not place.exists():
                lost.append(f"{page.relative_to(site)} -> {target}")
            elif anchor and place in pages and anchor not in pages[place].anchors:
                # Its own code-line anchors aside, MkDocs makes every anchor when it builds.
                lost.append(f"{page.relative_to(site)} -> {target} (no such anchor)")
    assert not lost


@pytest.mark.parametrize("name", [*PAGES, *(pytest.param(n, marks=pytest.mark.slow) for n in MORE)])
def test_a_page_loads_alone_and_fits_every_screen(site, browser, name):
    """Nothing errs, and nothing but files is asked for."""
    trouble: list[str] = []

    def heard(said) -> None:
        if said.type == "error":
            trouble.append(said.text)

    def only_files(route) -> None:
        if route.request.url.startswith("file:"):
            route.continue_()
        else:
            trouble.append(f"asked for {route.request.url}")
            route.abort()

    with closing(browser.new_context()) as context:
        context.route("**/*", only_files)
        page = context.new_page()
        page.set_default_timeout(20_000)
        page.on("console", heard)
        page.on("pageerror", lambda error: trouble.append(str(error)))
        page.goto((site / f"{name}.html").as_uri())
        # What the page's scripts do at once, done.
        page.wait_for_function("document.body.hasAttribute('data-md-color-scheme')")
        for width, height in (DESKTOP, PHONE):
            page.set_viewport_size({"width": width, "height": height})
            taken = page.evaluate("document.documentElement.scrollWidth")
            assert taken <= width, f"{taken} px wide"
    assert trouble == []
