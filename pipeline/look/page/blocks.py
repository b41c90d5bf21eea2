"""The blocks that a page is made of."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from matplotlib.figure import Figure

from pipeline.base.errors import Issue
from pipeline.base.text import Table


@dataclass(frozen=True)
class Text:
    """A paragraph of plain words; backticks make code."""

    words: str
    page: str = ""
    """A page to link to behind the words, relative to this one."""


@dataclass(frozen=True)
class Picture:
    """A figure: an SVG in the page, which follows light and dark, and `<name>.png` beside it."""

    name: str
    """File stem, unique in a report."""
    caption: str
    """What it shows and how to read it; also for screen readers."""
    draw: Callable[[], Figure]


@dataclass(frozen=True)
class Issues:
    """What looks wrong; times are seconds as the page counts them.

    If one issue occurs at several places, the page shows it once (`group_issues`). If there are no
    issues, it shows `none`.
    """

    issues: Sequence[Issue]
    none: str


@dataclass(frozen=True)
class TokenRun:
    """Consecutive tokens of one kind: `text` as the model has them, `note` such as "48 tokens"."""

    text: str
    kind: Literal["text", "special", "image"]
    note: str = ""


@dataclass(frozen=True)
class Tokens:
    """A prompt in reading order, special tokens and folded runs of image tokens marked."""

    runs: Sequence[TokenRun]


@dataclass(frozen=True)
class Outline:
    """A nested mapping (feature spec, params) as indented lines, folded."""

    title: str
    content: Mapping[str, Any]


Block = Text | Table | Picture | Issues | Tokens | Outline


@dataclass(frozen=True)
class Section:
    """A headed part of a page; `blocks` in reading order, `parts` one level below."""

    title: str
    blocks: Sequence[Block]
    parts: Sequence["Section"] = ()


BlockKind = TypeVar("BlockKind", bound=Block)


@dataclass(frozen=True)
class Report:
    """A page: a summary in one line, the figures that matter most, and its sections."""

    title: str
    summary: str
    tiles: Sequence[tuple[str, str]] = ()
    """(label, value), shown large at the top."""
    sections: Sequence[Section] = ()

    def blocks(self, kind: type[BlockKind]) -> Iterator[BlockKind]:
        """Its blocks of this kind, in reading order."""
        return _blocks(self.sections, kind)


def _blocks(sections: Sequence[Section], kind: type[BlockKind]) -> Iterator[BlockKind]:
    for section in sections:
        yield from (block for block in section.blocks if isinstance(block, kind))
        yield from _blocks(section.parts, kind)
