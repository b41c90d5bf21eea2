"""What a check of the machine says, and how it reads."""

import textwrap
from collections.abc import Sequence

from pipeline.base.issue import Issue

WIDTH = 100
_INDENT = 30
_WORDS = {"error": "missing"}
"""What the terminal calls a severity, where that is not its own word."""


def ok(subject: str, message: str) -> Issue:
    """It is as it should be."""
    return Issue(severity="ok", kind=subject, message=message)


def note(subject: str, message: str, remedy: str = "") -> Issue:
    """It works, but could be better; or it will be needed later."""
    return Issue(severity="note", kind=subject, message=message, remedy=remedy)


def missing(subject: str, message: str, remedy: str) -> Issue:
    """Without it a stage of the default pipeline does not run with these params."""
    return Issue(severity="error", kind=subject, message=message, remedy=remedy)


def described(title: str, issues: Sequence[Issue]) -> list[str]:
    """A group of issues as lines of at most `WIDTH` columns."""
    lines = [title]
    for issue in issues:
        head = f"  {_WORDS.get(issue.severity, issue.severity):<8} {issue.kind:<18} "
        lines += _wrapped(issue.message, head.ljust(_INDENT))
        if issue.remedy:
            lines += _wrapped(issue.remedy, f"{'-> ':>{_INDENT}}")
    return [*lines, ""]


def _wrapped(text: str, head: str) -> list[str]:
    # A path or an option is copied, so it is never broken.
    wrapped = textwrap.wrap(
        text,
        WIDTH,
        initial_indent=head,
        subsequent_indent=" " * len(head),
        break_long_words=False,
        break_on_hyphens=False,
    )
    return wrapped or [head]
