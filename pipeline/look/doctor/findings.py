"""What a check of the machine says, and how it reads."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

WIDTH = 100
_INDENT = 30
Level = Literal["ok", "note", "missing"]


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    level: Level
    """`ok`, a `note` on what is slower or smaller than it could be, or `missing`: nothing runs."""
    subject: str
    found: str
    remedy: str = ""
    """What to install, set or run."""


def ok(subject: str, found: str) -> Finding:
    """It is as it should be."""
    return Finding("ok", subject, found)


def note(subject: str, found: str, remedy: str = "") -> Finding:
    """It works, but could be better; or it will be needed later."""
    return Finding("note", subject, found, remedy)


def missing(subject: str, found: str, remedy: str) -> Finding:
    """Without it a stage of the default pipeline does not run with these params."""
    return Finding("missing", subject, found, remedy)


def described(title: str, findings: Sequence[Finding]) -> list[str]:
    """A group of findings as lines of at most `WIDTH` columns."""
    lines = [title]
    for finding in findings:
        head = f"  {finding.level:<8} {finding.subject:<18} "
        lines += _wrapped(finding.found, head.ljust(_INDENT))
        if finding.remedy:
            lines += _wrapped(finding.remedy, f"{'-> ':>{_INDENT}}")
    return [*lines, ""]


def _wrapped(text: str, head: str) -> list[str]:
    # A path or an option is copied, so it is never broken.
    wrapped = textwrap.wrap(text, WIDTH - len(head), break_long_words=False, break_on_hyphens=False)
    return [
        (head if at == 0 else " " * len(head)) + line for at, line in enumerate(wrapped or [""])
    ]
