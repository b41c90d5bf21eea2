"""What this machine has, lacks and could have for the pipeline, and what to install or set."""

import textwrap
from collections.abc import Generator, Sequence
from importlib import import_module

from pipeline.base.config import Params
from pipeline.base.errors import PipelineError
from pipeline.base.issue import Issue

WIDTH = 100
_INDENT = 30
GROUPS = {
    "Python and packages": "packages",
    "GPU": "gpu",
    "Vision-language model": "checkpoint",
    "Recordings": "data",
    "The store": "space",
}
"""Title and module of this package, whose `check` gives issues from `Params`."""


def examine(params: Params) -> Generator[tuple[str, list[Issue]]]:
    """Each group's title and issues, one after the other; what cannot be looked at is an issue.

    A group is imported when its turn comes, so that a package that is broken or missing is an
    issue and not the end.
    """
    for title, module in GROUPS.items():
        try:
            issues = list(import_module(f"pipeline.look.doctor.{module}").check(params))
        except (ImportError, OSError, PipelineError) as error:
            text = f"cannot be looked at: {error}"
            issues = [missing(module, text, "install or mend that, and run this again")]
        yield title, issues


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
