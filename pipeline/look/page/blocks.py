"""What a page is made of, before it is HTML."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from matplotlib.figure import Figure

from pipeline.base.issue import Issue
from pipeline.base.table import Table


@dataclass(frozen=True)
class Text:
    """A paragraph of plain words; backticks make code."""

    words: str
    page: str = ""
    """Another page of this project, relative to this one, that a link behind the words opens."""


@dataclass(frozen=True)
class Picture:
    """A figure: in the page as SVG that follows light and dark, beside it as `<name>.png`."""

    name: str
    """File stem, once in a report."""
    caption: str
    """What is seen and how to read it; also what a screen reader says."""
    draw: Callable[[], Figure]


@dataclass(frozen=True)
class Issues:
    """What looks wrong, of which times are seconds as the page counts them.

    The page shows the same issue at several places once (`group_issues`), and says `none` where
    there is no issue.
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
class Document:
    """A nested document (feature spec, params), folded, as indented YAML-like lines."""

    title: str
    content: Mapping[str, Any]


Block = Text | Table | Picture | Issues | Tokens | Document


@dataclass(frozen=True)
class Section:
    """A headed part of a page; `blocks` in reading order, `parts` one level below."""

    title: str
    blocks: Sequence[Block]
    parts: Sequence["Section"] = ()


BlockKind = TypeVar("BlockKind", bound=Block)


@dataclass(frozen=True)
class Report:
    """A page: what it is of in one line, the figures that matter most, and its sections."""

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
