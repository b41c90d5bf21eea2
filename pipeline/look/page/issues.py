"""Issues in groups, as a page, a terminal and `findings.csv` show them."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

from pipeline.base.errors import Issue, Severity
from pipeline.base.text import Table

FINDINGS = "findings.csv"


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
