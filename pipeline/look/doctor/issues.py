"""What a check of the machine says, and how it reads."""

import textwrap
from collections.abc import Sequence

from pipeline.base.issue import Issue

WIDTH = 100
_INDENT = 30


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
        severity = "missing" if issue.severity == "error" else issue.severity
        head = f"  {severity:<8} {issue.kind:<18} ".ljust(_INDENT)
        for begin, text in ((head, issue.message), (f"{'-> ':>{_INDENT}}", issue.remedy)):
            # A path or an option is copied, so it is never broken.
            wrapper = textwrap.TextWrapper(
                WIDTH, begin, " " * len(begin), break_long_words=False, break_on_hyphens=False
            )
            lines += wrapper.wrap(text)
    return [*lines, ""]
