"""What looks wrong, as a page, a terminal and `findings.csv` tell it: once, with all its places."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

from pipeline.base.issue import Issue, Severity
from pipeline.base.table import Table

FINDINGS = "findings.csv"


@dataclass(frozen=True)
class IssueGroup:
    """Issues of one severity, kind and stream; the message of the first stands for all."""

    severity: Severity
    kind: str
    where: str
    """The stream; then, of one issue, its episode and time, of several, how many there are."""
    issues: tuple[Issue, ...]
    """`episode` is what a reader calls the place: it names the source where there are several."""


def group_issues(issues: Sequence[Issue]) -> list[IssueGroup]:
    """The same issues together: errors first, then what stands at most places."""
    several = len({issue.source for issue in issues}) > 1
    alike: dict[tuple[Severity, str, str], list[Issue]] = defaultdict(list)
    for issue in issues:
        named = f"{issue.source}/{issue.episode}" if several and issue.episode else issue.episode
        key = issue.severity, issue.kind, issue.stream
        alike[key].append(replace(issue, episode=named or issue.source))
    groups = [
        IssueGroup(severity, kind, _where(stream, group), tuple(group))
        for (severity, kind, stream), group in alike.items()
    ]
    return sorted(groups, key=lambda group: (group.severity != "error", -len(group.issues)))


def place_of(issue: Issue) -> str:
    """Episode and time of an issue: `e0 0.00–1.00 s`."""
    if issue.start_s is None:
        return issue.episode
    start = f"{issue.start_s:.2f}"
    stop = start if issue.stop_s is None else f"{issue.stop_s:.2f}"
    return f"{issue.episode} {start if stop == start else f'{start}–{stop}'} s".lstrip()


def findings_csv(issues: Sequence[Issue]) -> str:
    """A line an issue for programs, in the order of the page; times are seconds as it counts."""
    heads = ("severity", "kind", "stream", "episode", "start_s", "stop_s", "message")
    rows = [
        (
            *(issue.severity, issue.kind, issue.stream, issue.episode),
            *(_seconds(issue.start_s), _seconds(issue.stop_s), issue.message),
        )
        for group in group_issues(issues)
        for issue in group.issues
    ]
    return Table(heads, rows).csv()


def _seconds(at: float | None) -> str:
    return "" if at is None else f"{at:.3f}"


def _where(stream: str, group: Sequence[Issue]) -> str:
    places, episodes = len(group), len({(issue.source, issue.episode) for issue in group})
    among = "1 episode" if episodes == 1 else f"{episodes:,} episodes"
    count = among if places == episodes else f"{places:,} places in {among}"
    words = place_of(group[0]) if places == 1 else count
    return " · ".join(part for part in (stream, words) if part)
