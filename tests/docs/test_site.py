"""The built site in a real browser, from a folder: no errors, no other host."""

import re
from collections.abc import Callable, Iterator
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


class Reader:
    """A page in the browser, and what it did that it must not: errors, requests to another host."""

    def __init__(self, browser, **options) -> None:
        self.trouble: list[str] = []
        self.context = browser.new_context(**options)
        self.page = self.context.new_page()
        self.page.set_default_timeout(20_000)
        self.page.on("console", self._heard)
        self.page.on("pageerror", lambda error: self.trouble.append(str(error)))
        self.context.route("**/*", self._only_files)

    def _heard(self, said) -> None:
        if said.type == "error":
            self.trouble.append(said.text)

    def _only_files(self, route) -> None:
        if route.request.url.startswith("file:"):
            route.continue_()
        else:
            self.trouble.append(f"asked for {route.request.url}")
            route.abort()


@pytest.fixture
def reader(browser) -> Iterator[Callable[..., Reader]]:
    """`reader(**context)`: a reader, of whom nothing but files may have been asked in the end."""
    readers: list[Reader] = []

    def come(**options) -> Reader:
        readers.append(Reader(browser, **options))
        return readers[-1]

    yield come
    for one in readers:
        one.context.close()
    assert [trouble for one in readers for trouble in one.trouble] == []


def open_page(visitor: Reader, path: Path) -> None:
    visitor.page.goto(path.as_uri())
    # What the page's scripts do at once, done.
    visitor.page.wait_for_function("document.body.hasAttribute('data-md-color-scheme')")
    assert not visitor.trouble, f"{path.name}: {visitor.trouble}"


def width(visitor: Reader) -> int:
    return visitor.page.evaluate("document.documentElement.scrollWidth")


@pytest.mark.parametrize("name", [*PAGES, *(pytest.param(n, marks=pytest.mark.slow) for n in MORE)])
def test_a_page_loads_alone_and_fits_every_screen(site, reader, name):
    visitor = reader(viewport={"width": DESKTOP[0], "height": DESKTOP[1]})
    open_page(visitor, site / f"{name}.html")
    for size in (DESKTOP, PHONE):
        visitor.page.set_viewport_size({"width": size[0], "height": size[1]})
        assert width(visitor) <= size[0], f"{width(visitor)} px wide"
