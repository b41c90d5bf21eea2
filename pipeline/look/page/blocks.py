"""What a page is made of, before it is HTML."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from matplotlib.figure import Figure


@dataclass(frozen=True)
class Text:
    """A paragraph of plain words; backticks make code."""

    words: str


@dataclass(frozen=True)
class Table:
    """Rows of cells under column heads; numbers stand right, in as many digits as they deserve."""

    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    caption: str = ""
    strong: frozenset[int] = frozenset()
    """Rows that stand out."""


@dataclass(frozen=True)
class Picture:
    """A figure: in the page as SVG that follows light and dark, beside it as `<name>.png`."""

    name: str
    """File stem, once in a report."""
    caption: str
    """What is seen and how to read it; also what a screen reader says."""
    draw: Callable[[], Figure]


@dataclass(frozen=True)
class Chart:
    """A plotly figure that can be zoomed and hovered, and the same figure for paper."""

    picture: Picture
    """Writes the PNG, and stands in where scripts are off."""
    figure: Any
    """`plotly.graph_objects.Figure`."""


@dataclass(frozen=True)
class Place:
    """One place of a notice: `str` says the episode and the time."""

    episode: str
    stream: str
    start_s: float | None
    """Since the instant from which the page counts; None where it is all of the stream."""
    stop_s: float | None
    message: str
    """What was found there."""

    def __str__(self) -> str:
        if self.start_s is None:
            return self.episode
        start = f"{self.start_s:.2f}"
        stop = start if self.stop_s is None else f"{self.stop_s:.2f}"
        return f"{self.episode} {start if stop == start else f'{start}–{stop}'} s".lstrip()


@dataclass(frozen=True)
class Notice:
    """One thing that looks wrong: how bad, where (episode, stream, time), and what."""

    severity: Literal["error", "warning"]
    kind: str
    where: str
    message: str
    """Of several places, what was found at the first."""
    places: Sequence[Place] = ()
    """All of them; where they are several, `where` says how many and names none."""


@dataclass(frozen=True)
class Notices:
    """What looks wrong, worst first; `none` is said where there is nothing."""

    notices: Sequence[Notice]
    none: str


@dataclass(frozen=True)
class Run:
    """Consecutive tokens of one kind: `text` as the model has them, `note` such as "48 tokens"."""

    text: str
    kind: Literal["text", "special", "image"]
    note: str = ""


@dataclass(frozen=True)
class Tokens:
    """A prompt in reading order, special tokens and folded runs of image tokens marked."""

    runs: Sequence[Run]


@dataclass(frozen=True)
class Document:
    """A nested document (feature spec, params), folded, as indented YAML-like lines."""

    title: str
    content: Mapping[str, Any]


Block = Text | Table | Picture | Chart | Notices | Tokens | Document


@dataclass(frozen=True)
class Section:
    """A headed part of a page; `blocks` in reading order, `parts` one level below."""

    title: str
    blocks: Sequence[Block]
    parts: Sequence["Section"] = ()


_Kind = TypeVar("_Kind")


@dataclass(frozen=True)
class Report:
    """A page: what it is of in one line, the figures that matter most, and its sections."""

    title: str
    summary: str
    tiles: Sequence[tuple[str, str]] = ()
    """(label, value), shown large at the top."""
    sections: Sequence[Section] = field(default_factory=tuple)

    def blocks(self, *kinds: type[_Kind]) -> Iterator[_Kind]:
        """Its blocks of these kinds, in reading order."""
        return _blocks(self.sections, kinds)


def _blocks(sections: Sequence[Section], kinds: tuple[type[_Kind], ...]) -> Iterator[_Kind]:
    for section in sections:
        for block in section.blocks:
            if isinstance(block, kinds):
                yield block
        yield from _blocks(section.parts, kinds)
