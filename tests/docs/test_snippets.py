"""Every Python snippet of the documentation runs, page by page, on a small demo.

A comment before a block says what it needs: `<!-- needs: tensorstore -->` a module that may be
missing, `<!-- no-run: why -->` something that no test has.
"""

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tests.docs.conftest import PAGES, ROOT

BLOCK = re.compile(
    r"^(?P<marks>(?:<!-- [^>]*-->\s*\n)*)```python\n(?P<code>.*?)^```$", re.DOTALL | re.MULTILINE
)
MARK = re.compile(r"<!-- (?P<kind>no-run|needs): (?P<said>[^>]+?) -->")


@dataclass(frozen=True)
class Snippet:
    """A block of Python: its line in the page, its text, what stands before it."""

    line: int
    code: str
    marks: dict[str, str]


def snippets(page: Path) -> Iterator[Snippet]:
    text = page.read_text(encoding="utf-8")
    for match in BLOCK.finditer(text):
        marks = {mark["kind"]: mark["said"] for mark in MARK.finditer(match["marks"])}
        yield Snippet(text.count("\n", 0, match.start("code")) + 1, match["code"], marks)


def with_snippets() -> Iterator[Any]:
    for page in PAGES:
        marks = [one.marks for one in snippets(page) if "no-run" not in one.marks]
        extra = [pytest.mark.extra] if any("needs" in one for one in marks) else []
        if marks:
            yield pytest.param(page, marks=extra, id=str(page.relative_to(ROOT)))


@pytest.mark.filterwarnings("default")  # what a snippet's libraries warn of is not ours to mend
@pytest.mark.parametrize("page", list(with_snippets()))
def test_the_snippets_of_a_page_run(page, demo, monkeypatch):
    monkeypatch.chdir(demo)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    # Dataclasses and annotations look their module up.
    module = ModuleType("documentation_snippet")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    untried = []
    for snippet in snippets(page):
        if "no-run" in snippet.marks:
            continue
        if "needs" in snippet.marks:
            try:
                __import__(snippet.marks["needs"])
            except ImportError:
                untried.append(f"line {snippet.line}: {snippet.marks['needs']} is not installed")
                continue
        # Blank lines before it, so that a traceback names the line of the page.
        code = compile("\n" * (snippet.line - 1) + snippet.code, str(page), "exec")
        exec(code, vars(module))
    if untried:
        pytest.skip(f"all other snippets ran; {'; '.join(untried)}")


def test_every_snippet_is_at_least_python():
    """Also those that cannot run: a part of a file still parses."""
    for page in PAGES:
        for snippet in snippets(page):
            compile(snippet.code, f"{page}:{snippet.line}", "exec")


def test_the_store_page_has_a_snippet_of_each_library():
    code = "\n".join(one.code for one in snippets(ROOT / "docs" / "store.md"))
    for library in ("FeatureStore", "numpy", "zarr", "xarray", "dask"):
        assert re.search(rf"import {library}\b", code), library
