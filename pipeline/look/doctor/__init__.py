"""What this machine has, lacks and could have for the pipeline, and what to install or set."""

from collections.abc import Generator
from importlib import import_module

from pipeline.base.config import Params
from pipeline.base.errors import PipelineError
from pipeline.base.issue import Issue
from pipeline.look.doctor.issues import described, missing, note

__all__ = ["GROUPS", "described", "examine"]

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
        except (ImportError, PipelineError) as error:
            text = f"cannot be looked at: {error}"
            issues = [missing(module, text, "install or mend that, and run this again")]
        except OSError as error:
            issues = [note(module, f"not known: {error}", "look at that path")]
        yield title, issues
