"""What this machine has, lacks and could have for the pipeline, and what to install or set."""

import sys
import textwrap
import tomllib
from collections.abc import Callable, Generator, Iterator, Sequence
from importlib import import_module, metadata
from pathlib import Path

from packaging.requirements import Requirement

from pipeline.base.config import Params
from pipeline.base.errors import Issue, PipelineError

WIDTH = 100
_INDENT = 30
GROUPS = {
    "Python and packages": ("pipeline.look.doctor", "check_packages"),
    "GPU": ("pipeline.look.doctor.machine", "check_gpu"),
    "Vision-language model": ("pipeline.look.doctor.machine", "check_checkpoint"),
    "Recordings": ("pipeline.look.doctor.data", "check_recordings"),
}
"""Title -> module and function that gives issues from `Params`."""
_SHOWN = ("python", "torch", "transformers", "peft", "zarr", "numpy", "av", "dvc")


def examine(params: Params) -> Generator[tuple[str, list[Issue]]]:
    """Each group's title and issues, one after the other; a check that fails is an issue too.

    A group is imported when its turn comes, so a broken or missing package is an issue and does not
    end the examination.
    """
    for title, (module, function) in GROUPS.items():
        try:
            issues = list(getattr(import_module(module), function)(params))
        except (ImportError, OSError, PipelineError) as error:
            text = f"cannot be looked at: {error}"
            issues = [missing(title.lower(), text, "install or mend that, and run this again")]
        yield title, issues


def ok(subject: str, message: str) -> Issue:
    """An issue that says that the subject is as it should be."""
    return Issue(severity="ok", kind=subject, message=message)


def note(subject: str, message: str, remedy: str = "") -> Issue:
    """An issue about what works but could be better, or what will be needed later."""
    return Issue(severity="note", kind=subject, message=message, remedy=remedy)


def missing(subject: str, message: str, remedy: str) -> Issue:
    """An issue about what a stage of the default pipeline needs to run with these params."""
    return Issue(severity="error", kind=subject, message=message, remedy=remedy)


def describe(title: str, issues: Sequence[Issue]) -> list[str]:
    """A group of issues as lines of at most `WIDTH` columns."""
    lines = [title]
    for issue in issues:
        severity = "missing" if issue.severity == "error" else issue.severity
        head = f"  {severity:<8} {issue.kind:<18} ".ljust(_INDENT)
        for begin, text in ((head, issue.message), (f"{'-> ':>{_INDENT}}", issue.remedy)):
            # Users copy paths and options, so these are never broken.
            wrapper = textwrap.TextWrapper(
                WIDTH, begin, " " * len(begin), break_long_words=False, break_on_hyphens=False
            )
            lines += wrapper.wrap(text)
    return [*lines, ""]


def check_packages(params: Params) -> Iterator[Issue]:
    """Python, the packages that are needed, and those of the loggers that the params name.

    The ranges are those of pyproject.toml in the checkout, which may be newer than what was
    installed.
    """
    pyproject = Path(__file__).parents[3] / "pyproject.toml"
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    loggers = project["optional-dependencies"]["loggers"]
    lines = [
        f"python{project['requires-python']}",
        *project["dependencies"],
        *(line for line in loggers if Requirement(line).name in params.train_head.loggers),
    ]
    return check_required(lines, installed_version)


def installed_version(name: str) -> str | None:
    """The version of Python or of an installed package; None where there is none."""
    if name == "python":
        return ".".join(map(str, sys.version_info[:3]))
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def check_required(
    lines: Sequence[str], version_of: Callable[[str], str | None]
) -> Iterator[Issue]:
    """One issue for all packages within their range, and one for each that is not."""
    good: dict[str, str] = {}
    bad: list[Issue] = []
    for line in lines:
        wanted = Requirement(line)
        name, version = wanted.name, version_of(wanted.name)
        # A build such as 2.13.0+cpu, or a nightly, counts by its number.
        if version and wanted.specifier.contains(version.split("+")[0], prereleases=True):
            good[name] = version
            continue
        text = f"expected {line}, found {version or 'none'}"
        remedy = f"make an environment of {line}" if name == "python" else f"pip install '{line}'"
        bad.append(missing(name, text, remedy))
    shown = ", ".join(f"{name} {good[name]}" for name in _SHOWN if name in good)
    yield ok("packages", f"{len(good)} of {len(lines)} as they should be: {shown}")
    yield from bad
