"""Which packages are installed, against the ranges that this project asks for."""

import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

from pipeline.base.config import Params
from pipeline.base.issue import Issue
from pipeline.look.doctor import missing, ok

_SHOWN = ("python", "torch", "transformers", "peft", "zarr", "numpy", "av", "dvc")


def check(params: Params) -> Iterator[Issue]:
    """Python, the packages that are needed and those of the loggers that the params name.

    Asked for is what pyproject.toml of the checkout says: what was installed may be older than it.
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
    """One line for all that are as they should be, and one for each that is not."""
    good: dict[str, str] = {}
    bad: list[Issue] = []
    for line in lines:
        wanted = Requirement(line)
        name, version = wanted.name, version_of(wanted.name)
        # A build such as 2.13.0+cpu, or a nightly, is what its number says.
        if version and wanted.specifier.contains(version.split("+")[0], prereleases=True):
            good[name] = version
            continue
        found = f"expected {line}, found {version or 'none'}"
        remedy = f"make an environment of {line}" if name == "python" else f"pip install '{line}'"
        bad.append(missing(name, found, remedy))
    shown = ", ".join(f"{name} {good[name]}" for name in _SHOWN if name in good)
    yield ok("packages", f"{len(good)} of {len(lines)} as they should be: {shown}")
    yield from bad
