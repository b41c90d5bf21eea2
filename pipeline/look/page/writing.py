"""`Report` -> `report.html`, one file that needs no other file, and PNG files.

The page makes no request: it contains its styles, script and pictures, and its content security
policy forbids the rest. The same report gives the same bytes.
"""

import re
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape
from tqdm import tqdm

from pipeline.base.files import (
    OutputKind,
    begin_folder,
    disk_full_named,
    remove_folder,
    sync,
)
from pipeline.base.text import as_yaml
from pipeline.look.page.blocks import (
    FINDINGS,
    Block,
    Issues,
    Picture,
    Report,
    Section,
    findings_csv,
    group_issues,
    place_of,
    places_of,
)
from pipeline.look.page.style import RC, inline_svg, write

PAGE = "report.html"
OPEN_GROUPS = 12
"""The most groups of issues that are shown at once; the others unfold."""
NAMED_PLACES = 3
"""The most issues of a group that are shown at once; all of them unfold."""
MOST_PLACES = 300
"""The most issues of a group in the page; `findings.csv` has all."""
_WRITTEN = re.compile(r'<meta name="pictures" content="([^"]*)">')
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
_TEMPORARY = OutputKind("a page in the making", Path.is_dir)


def write_report(folder: Path, report: Report) -> list[Path]:
    """Write `report.html` and `<name>.png` of every picture into `folder`; return their paths.

    All issues of a page are also in `findings.csv` beside it. Pictures are drawn one at a time.
    Each file is put in place whole, the page last, so a kill leaves the old page. Pictures of the
    old page that this one lacks are removed; no other file in `folder` is touched. The caller must
    have checked that the folder may be written to. Raises `DiskFull` with the old page in place.
    """
    names = [picture.name for picture in report.blocks(Picture)]
    temporary = folder / f".{PAGE}.new"
    with disk_full_named(folder):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            begin_folder(temporary, _TEMPORARY)
            texts = {PAGE: _PageWriter(temporary).html(report, names)}
            # The first block of issues holds those of the whole page.
            if issues := next(report.blocks(Issues), None):
                texts = {FINDINGS: findings_csv(issues.issues), **texts}
            for name, text in texts.items():
                # A file's name may have bytes that are not text: they are shown as \udcXX.
                (temporary / name).write_text(text, encoding="utf-8", errors="backslashreplace")
            return _put_in_place(temporary, folder, [*(f"{name}.png" for name in names), *texts])
        finally:
            remove_folder(temporary, _TEMPORARY)


def _put_in_place(temporary: Path, folder: Path, files: Sequence[str]) -> list[Path]:
    for file in files:
        sync(temporary / file)
    page = folder / PAGE
    before = page.read_text(encoding="utf-8", errors="replace") if page.is_file() else ""
    for file in files:
        (temporary / file).replace(folder / file)
    for name in filter(_NAME.fullmatch, " ".join(_WRITTEN.findall(before)).split()):
        if f"{name}.png" not in files:
            (folder / f"{name}.png").unlink(missing_ok=True)
    sync(folder)
    return [folder / file for file in (PAGE, *files[:-1])]


class _PageWriter:
    """Renders one page and writes its pictures into a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._anchors = Counter(["top"])
        self._jinja = Environment(
            loader=FileSystemLoader(Path(__file__).parent / "templates"),
            autoescape=True,
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        filters: dict[str, Any] = {"prose": prose, "breakable": breakable, "yaml": as_yaml}
        filters |= {"groups": group_issues, "place": place_of, "places": places_of}
        self._jinja.filters.update(filters | {"drawn": self._draw})
        limits = {"open": OPEN_GROUPS, "named": NAMED_PLACES, "listed": MOST_PLACES}
        shown = {**limits, "findings": FINDINGS}
        self._blocks: Any = self._jinja.get_template("blocks.html", globals=shown).module

    def html(self, report: Report, pictures: Sequence[str]) -> str:
        """The whole page, after its pictures were written."""
        bar = tqdm(total=len(pictures), desc="pictures", unit="", disable=None)
        with bar as self._bar, mpl.rc_context(RC), warnings.catch_warnings():
            # Where this machine has no font for a letter, PNG files show a box; the page does not.
            warnings.filterwarnings("ignore", r"Glyph \d+ ", UserWarning)
            sections = [self._section(section) for section in report.sections]
        page = self._jinja.get_template("page.html")
        names = " ".join(pictures)
        return page.render(report=report, sections=sections, pictures=names)

    def _section(self, section: Section) -> dict[str, Any]:
        return {
            "title": section.title,
            "anchor": self._anchor(section.title),
            "blocks": [self._block(block) for block in section.blocks],
            "parts": [self._section(part) for part in section.parts],
        }

    def _anchor(self, title: str) -> str:
        stem = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-") or "section"
        self._anchors[stem] += 1
        count = self._anchors[stem]
        return stem if count == 1 else f"{stem}-{count}"

    def _block(self, block: Block) -> Markup:
        """The block, by the macro of `blocks.html` with the name of its class."""
        return getattr(self._blocks, type(block).__name__.lower())(block)

    def _draw(self, picture: Picture) -> Markup:
        """The picture as SVG; the same figure is written as PNG."""
        figure = picture.draw()
        write(self._folder, {f"{picture.name}.png": lambda: figure})
        svg = inline_svg(figure, picture.name, picture.caption)
        self._bar.update()
        return Markup(svg)


def sentence(words: str) -> str:
    """Words of a table or a terminal as a sentence, with a capital letter and a full stop."""
    return f"{words[0].upper()}{words[1:]}."


def prose(words: str) -> Markup:
    """Plain words; words in backticks are code."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(words))))


def breakable(words: str) -> Markup:
    """Words, a path or an id, that may break after a `/` or `_` inside."""
    return Markup(re.sub(r"(?<=\w)([/_])", r"\1<wbr>", str(escape(words))))
