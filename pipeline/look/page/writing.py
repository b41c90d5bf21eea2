"""`Report` -> `report.html`, one file that needs nothing beside itself, and PNG files.

The page makes no request: styles, scripts, pictures and plotly.js stand in it, and its content
security policy forbids the rest. The same report gives the same bytes.
"""

import json
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import matplotlib as mpl
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from tqdm import tqdm

from pipeline.base.durable import disk_full_named, sync
from pipeline.base.ownership import REPORT, OutputKind, begin_folder, release, remove_folder
from pipeline.look.page.blocks import (
    Block,
    Chart,
    Document,
    Notices,
    Picture,
    Report,
    Section,
    Table,
    Text,
    Tokens,
)
from pipeline.look.page.cells import breakable, columns_of, prose
from pipeline.look.page.charts import chart_json, plotly_script
from pipeline.look.page.findings import FINDINGS, findings_csv
from pipeline.look.page.style import NO_FONT, RC, boxes, write
from pipeline.look.page.svg import inline_svg

PAGE = "report.html"
OPEN_NOTICES = 12
"""Notices that show at once; the rest unfold."""
NAMED_PLACES = 3
"""Of a notice, those that show at once; all of them unfold."""
MOST_PLACES = 300
"""Of a notice, those that the page lists; more stand in `findings.csv` only."""
_TEMPLATES = Path(__file__).parent / "templates"
_WRITTEN = re.compile(r'<meta name="pictures" content="([^"]*)">')
_TEMPORARY = OutputKind("a page in the making", Path.is_dir)
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


def write_report(folder: Path, report: Report) -> list[Path]:
    """Write `report.html` and `<name>.png` of every picture into `folder`; return their paths.

    A page that says what looks wrong has all of it in `findings.csv` beside it. Pictures are drawn
    one at a time. Each file is put in place whole, the page last, so that a kill leaves the old
    page. Pictures that the page of before had and this one has not are removed; of other files in
    `folder` none is touched: whose that is, the caller has asked. Raises `DiskFull` with the old
    page in place, and `ValueError` for a picture's name that is twice in the report or no plain
    file stem.
    """
    names = [picture.name for picture in _pictures(report)]
    _check_names(names)
    temporary = folder / f".{PAGE}.new"
    with disk_full_named(folder):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            begin_folder(temporary, _TEMPORARY)
            page = _Page(report, temporary, names).html()
            # A file's name need not be text: what is none is shown as \udcXX.
            texts = {**_findings(report), PAGE: page}
            for name, text in texts.items():
                (temporary / name).write_text(text, encoding="utf-8", errors="backslashreplace")
            return _put_in_place(temporary, folder, names, texts)
        finally:
            remove_folder(temporary, _TEMPORARY)
            release(folder, REPORT)


def _put_in_place(
    temporary: Path, folder: Path, names: Sequence[str], texts: Iterable[str]
) -> list[Path]:
    page = folder / PAGE
    files = [*(f"{name}.png" for name in names), *texts]
    for file in files:
        sync(temporary / file)
    before = _pictures_of(page)
    for file in files:
        (temporary / file).replace(folder / file)
    for name in before - set(names):
        (folder / f"{name}.png").unlink(missing_ok=True)
    sync(folder)
    return [page, *(folder / file for file in files[:-1])]


def _findings(report: Report) -> dict[str, str]:
    """The first notices are those of all; those of single parts come later."""
    found = next(report.blocks(Notices), None)
    return {} if found is None else {FINDINGS: findings_csv(found)}


def _pictures_of(page: Path) -> set[str]:
    """Names of the pictures that were written with a page; of no page, none."""
    if not page.is_file():
        return set()
    with page.open(encoding="utf-8", errors="replace") as file:
        found = _WRITTEN.search(file.read(2**16))
    names = found[1].split() if found else []
    return {name for name in names if _NAME.fullmatch(name)}


def _pictures(report: Report) -> Iterator[Picture]:
    for block in report.blocks(Picture, Chart):
        yield block.picture if isinstance(block, Chart) else block


def _check_names(names: Sequence[str]) -> None:
    for name in names:
        if not _NAME.fullmatch(name):
            raise ValueError(f"a picture's name is a plain file stem, found {name!r}")
        if names.count(name) > 1:
            raise ValueError(f"the picture {name!r} stands twice in the report")


class _Page:
    """One page in the making: its pictures' folder, the anchors taken, whether it has charts."""

    def __init__(self, report: Report, pictures: Path, names: Sequence[str]) -> None:
        self._jinja = Environment(
            loader=FileSystemLoader(_TEMPLATES),
            autoescape=True,
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        self._jinja.filters |= {"prose": prose, "breakable": breakable}
        limits = {"named": NAMED_PLACES, "listed": MOST_PLACES, "findings": FINDINGS}
        self._blocks: Any = self._jinja.get_template("blocks.html", globals=limits).module
        self._report, self._pictures, self._names = report, pictures, names
        self._anchors: set[str] = {"top"}
        self._charts = 0

    def html(self) -> str:
        """The whole page."""
        bar = tqdm(total=len(self._names), desc="pictures", unit="", disable=None)
        with bar as self._bar, boxes() as said:
            sections = [self._section(section) for section in self._report.sections]
        if said:
            warnings.warn(NO_FONT, stacklevel=3)
        return self._jinja.get_template("page.html").render(
            report=self._report,
            said=said,
            sections=sections,
            pictures=" ".join(self._names),
            style=self._inlined("page.css"),
            script=self._inlined("page.js"),
            plotly=plotly_script() if self._charts else "",
            chart_script=self._inlined("charts.js") if self._charts else "",
        )

    def _inlined(self, name: str) -> Markup:
        return Markup((_TEMPLATES / name).read_text(encoding="utf-8"))

    def _section(self, section: Section) -> dict[str, Any]:
        return {
            "title": section.title,
            "anchor": self._anchor(section.title),
            "blocks": [self._block(block) for block in section.blocks],
            "parts": [self._section(part) for part in section.parts],
        }

    def _anchor(self, title: str) -> str:
        stem = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-") or "section"
        anchor, count = stem, 1
        while anchor in self._anchors:
            count += 1
            anchor = f"{stem}-{count}"
        self._anchors.add(anchor)
        return anchor

    def _block(self, block: Block) -> Markup:
        match block:
            case Text():
                return self._blocks.text(block.words)
            case Table():
                columns = columns_of(block.columns, block.rows)
                return self._blocks.table(block, columns)
            case Picture():
                return self._blocks.picture(block, self._draw(block))
            case Chart():
                return self._chart(block)
            case Notices():
                order = sorted(block.notices, key=lambda one: one.severity != "error")
                return self._blocks.notices(order, OPEN_NOTICES, block.none)
            case Tokens():
                return self._blocks.tokens([asdict(run) for run in block.runs])
            case Document():
                return self._blocks.document(block.title, document_lines(block.content))

    def _chart(self, chart: Chart) -> Markup:
        self._charts += 1
        height = chart.figure.layout.height or 480
        svg = self._draw(chart.picture)
        return self._blocks.chart(chart.picture, svg, chart_json(chart.figure), height)

    def _draw(self, picture: Picture) -> Markup:
        """The picture as SVG; its PNG is written on the way, from the same figure."""
        with mpl.rc_context(RC):
            figure = picture.draw()
            write(self._pictures, {f"{picture.name}.png": lambda: figure})
            svg = inline_svg(figure, picture.name, picture.caption)
        self._bar.update()
        return Markup(svg)


def document_lines(content: Mapping[str, Any], depth: int = 0) -> list[tuple[int, str, str]]:
    """A nested document as (depth, key, value) lines, in its own order."""
    lines: list[tuple[int, str, str]] = []
    for key, value in content.items():
        lines += _entry(depth, str(key), value)
    return lines


def _item(depth: int, value: Any) -> list[tuple[int, str, str]]:
    """An entry of a list: a flat mapping in one line."""
    if not isinstance(value, Mapping):
        return _entry(depth, "-", value)
    lines = document_lines(value)
    if any(inner for inner, _, _ in lines):
        return _entry(depth, "-", value)
    return [(depth, "-", ", ".join(f"{key}: {said}" for _, key, said in lines))]


def _entry(depth: int, key: str, value: Any) -> list[tuple[int, str, str]]:
    if isinstance(value, Mapping) and value:
        return [(depth, key, ""), *document_lines(value, depth + 1)]
    if isinstance(value, list | tuple) and any(isinstance(one, Mapping | list) for one in value):
        return [(depth, key, ""), *(line for one in value for line in _item(depth + 1, one))]
    if isinstance(value, str) and value.isprintable() and value == value.strip() != "":
        return [(depth, key, value)]
    return [(depth, key, json.dumps(value, ensure_ascii=False, default=str))]
