"""The blocks that a page is made of, and issues in groups, as a page and a terminal show them."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

from matplotlib.figure import Figure

from pipeline.base.errors import Issue, Severity
from pipeline.base.text import Table

FINDINGS = "findings.csv"


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


def next_steps(*steps: str) -> Section:
    """The last section of a page: what to do next, by the figures that the page shows."""
    return Section("What to do next", [Text(step) for step in steps if step])


BlockKind = TypeVar("BlockKind", bound=Block)


@dataclass(frozen=True)
class Report:
    """A page: a summary in one line, the figures that matter most, and its sections."""

    title: str
    summary: str
    tiles: Sequence[tuple[str, str]] = ()
    """(label, value), shown large at the top."""
    sections: Sequence[Section] = ()
    verdict: str = ""
    """What the page comes to, in a sentence, shown large above the summary."""

    def blocks(self, kind: type[BlockKind]) -> Iterator[BlockKind]:
        """Its blocks of this kind, in reading order."""
        return _blocks(self.sections, kind)


def _blocks(sections: Sequence[Section], kind: type[BlockKind]) -> Iterator[BlockKind]:
    for section in sections:
        yield from (block for block in section.blocks if isinstance(block, kind))
        yield from _blocks(section.parts, kind)


def group_issues(issues: Sequence[Issue]) -> list[list[Issue]]:
    """Groups of issues of one severity, kind and stream: errors first, then the largest groups.

    The first message stands for its group. `episode` becomes the name of the place, with the source
    if there are several sources.
    """
    several = len({issue.source for issue in issues}) > 1
    groups: dict[tuple[Severity, str, str], list[Issue]] = defaultdict(list)
    for issue in issues:
        name = f"{issue.source}/{issue.episode}" if several and issue.episode else issue.episode
        key = issue.severity, issue.kind, issue.stream
        groups[key].append(replace(issue, episode=name or issue.source))
    return sorted(groups.values(), key=lambda group: (group[0].severity != "error", -len(group)))


def places_of(group: Sequence[Issue]) -> str:
    """The stream; then the episode and time of a single issue, or the number of several."""
    places, episodes = len(group), len({(issue.source, issue.episode) for issue in group})
    words = "1 episode" if episodes == 1 else f"{episodes:,} episodes"
    if places > episodes:
        words = f"{places:,} places in {words}"
    if places == 1:
        words = place_of(group[0])
    return " · ".join(part for part in (group[0].stream, words) if part)


def place_of(issue: Issue) -> str:
    """Episode and time of an issue: `e0 0.00–1.00 s`."""
    if issue.start_s is None:
        return issue.episode
    start = f"{issue.start_s:.2f}"
    stop = start if issue.stop_s is None else f"{issue.stop_s:.2f}"
    return f"{issue.episode} {start if stop == start else f'{start}–{stop}'} s".lstrip()


def findings_csv(issues: Sequence[Issue]) -> str:
    """A line for each issue, for programs, in the order and with the times of the page."""
    heads = ("severity", "kind", "stream", "episode", "start_s", "stop_s", "message")
    rows: list[tuple[str, ...]] = []
    for issue in (issue for group in group_issues(issues) for issue in group):
        times = ["" if at is None else f"{at:.3f}" for at in (issue.start_s, issue.stop_s)]
        what = issue.severity, issue.kind, issue.stream, issue.episode
        rows.append((*what, *times, issue.message))
    return Table(heads, rows).csv()
