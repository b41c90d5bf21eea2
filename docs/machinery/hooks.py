"""What MkDocs does for this site beside its own work.

The keys of `params.md` and the pages of the reference are written from the code when the site is
built, so they cannot fall behind it. Figures stand in the pages as images, which every viewer of
Markdown shows; the site lays their SVG into the page itself, where it takes the colours of the
page, light or dark.
"""

import html
import posixpath
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [path for path in (str(HERE), str(ROOT)) if path not in sys.path]

from params_page import params_page  # noqa: E402
from reference_pages import reference_pages  # noqa: E402

REFERENCE = "reference/index.md"
IMAGE = re.compile(r'<p>\s*<img\s[^>]*?src="([^"]*figures/[\w-]+\.svg)"[^>]*>\s*</p>')
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(((?:\.\./)+[^)\s#]*)(?:#[^)\s]*)?\)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the pages of the reference into the navigation, behind their index."""

    def extend(entries: list[Any]) -> None:
        if REFERENCE in entries:
            entries += reference_pages()
        for entry in entries:
            if isinstance(entry, dict):
                for below in entry.values():
                    if isinstance(below, list):
                        extend(below)

    extend(config.nav or [])
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are written from the code."""
    for path, text in reference_pages().items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """List the params; name files outside `docs/` and do not link to them: the site has none."""
    if page.file.src_uri == "params.md":
        markdown = params_page(markdown)
    folder = Path(config.docs_dir) / posixpath.dirname(page.file.src_uri)

    def name(match: re.Match[str]) -> str:
        said, target = match.groups()
        place = (folder / target).resolve()
        if place.is_relative_to(config.docs_dir):
            return match.group()
        if not place.exists():
            raise PluginError(f"{page.file.src_uri}: {target} is not there")
        path = place.relative_to(ROOT).as_posix()
        return said if path in said else f"{said} (`{path}`)"

    return LINK.sub(name, markdown)


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lay each figure into the page."""

    def inline(match: re.Match[str]) -> str:
        path = Path(config.docs_dir) / "figures" / posixpath.basename(match[1])
        return _figure(path, match[1])

    return IMAGE.sub(inline, content)


def _figure(path: Path, link: str) -> str:
    """The drawing as an element of a page, without its own colours; it leads to the file."""
    text = path.read_text(encoding="utf-8")
    drawing = re.sub(r"<style>.*?</style>\n?", "", text, flags=re.DOTALL)
    # A page may hold the same drawing's parts under one name each.
    for name in _ids(text):
        drawing = re.sub(rf'(id="|url\(#){name}\b', rf"\g<1>{path.stem}-{name}", drawing)
    return f'<figure class="drawing"><a href="{link}">{drawing}</a></figure>'


def _ids(text: str) -> Iterator[str]:
    for element in ElementTree.fromstring(text).iter():
        if name := element.get("id"):
            yield re.escape(html.unescape(name))


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Refuse a page that would make a browser ask another host."""
    asked: list[Any] = re.findall(
        r'<(?:script|img|iframe|link)\b[^>]*(?:src|href)="(https?:[^"]+)"', output
    )
    foreign = [url for url in asked if f'rel="canonical" href="{url}"' not in output]
    if foreign:
        raise PluginError(f"{page.file.src_uri} would load {', '.join(foreign)}")
    return output
