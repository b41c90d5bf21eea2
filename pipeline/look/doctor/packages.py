"""Which packages are installed, against the ranges that this project asks for."""

import sys
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from pipeline.base.config import Params
from pipeline.look.doctor.findings import Finding, missing, ok

PROJECT = "vla-feature-cache"
_SHOWN = ("torch", "transformers", "peft", "zarr", "numpy", "av", "dvc")
VersionOf = Callable[[str], str | None]


@dataclass(frozen=True)
class Wanted:
    """What the project asks of an environment."""

    python: str
    """Range of versions."""
    packages: Sequence[str]
    """Requirements, as in pyproject.toml."""
    loggers: Sequence[str]
    """Those of the extra."""


def check_packages(params: Params) -> list[Finding]:
    """Python, the packages that are needed and those of loggers, as they are here."""
    wanted = read_wanted(Path(__file__).parents[2] / "pyproject.toml")
    python = ".".join(map(str, sys.version_info[:3]))
    return [
        check_python(wanted.python, python),
        *check_required(wanted.packages, installed_version),
        check_loggers(wanted.loggers, params.train_head.loggers, installed_version),
    ]


def read_wanted(pyproject: Path) -> Wanted:
    """What pyproject.toml of the checkout says: what was installed may be older than it."""
    project: dict[str, Any] = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    loggers = project["optional-dependencies"]["loggers"]
    return Wanted(project["requires-python"], project["dependencies"], loggers)


def installed_version(name: str) -> str | None:
    """The version of an installed package; None where there is none."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def check_python(wanted: str, found: str) -> Finding:
    """The interpreter."""
    if SpecifierSet(wanted).contains(found):
        return ok("python", f"{found} ({sys.executable})")
    remedy = "make a virtual environment with a newer Python and install again"
    return missing("python", f"{found}; expected {wanted}", remedy)


def check_required(packages: Sequence[str], version_of: VersionOf) -> list[Finding]:
    """One line for all that are as they should be, and one for each that is not."""
    found = {line: version_of(Requirement(line).name) for line in packages}
    good = [line for line in packages if _fits(line, found[line])]
    shown = ", ".join(
        f"{name} {found[line]}" for line in good if (name := Requirement(line).name) in _SHOWN
    )
    findings = [ok("packages", f"{len(good)} of {len(packages)} as pyproject.toml asks: {shown}")]
    for line in packages:
        if line not in good:
            name = Requirement(line).name
            said = f"expected {line}, found {found[line] or 'none'}"
            findings.append(missing(name, said, f"pip install '{line}'"))
    return findings


def check_loggers(extra: Sequence[str], loggers: Sequence[str], version_of: VersionOf) -> Finding:
    """The packages of the extra `loggers`, of which those that the params name are needed."""
    absent = {
        Requirement(line).name
        for line in extra
        if not _fits(line, version_of(Requirement(line).name))
    }
    asked = sorted(absent & {*loggers})
    remedy = f"pip install '{PROJECT}[loggers]', or in a checkout: pip install -e '.[loggers]'"
    if asked:
        said = f"train_head.loggers asks for {', '.join(asked)}, which is not installed"
        return missing("loggers", said, remedy)
    if absent:
        said = f"{', '.join(sorted(absent))} not installed; not needed with these params"
        return ok("loggers", said)
    return ok("loggers", "tensorboard and wandb are there for train_head.loggers")


def importable(name: str) -> bool:
    """Whether a module of this name is installed; a bare folder is none."""
    spec = find_spec(name)
    return spec is not None and spec.origin is not None


def _fits(line: str, found: str | None) -> bool:
    if found is None:
        return False
    # A build such as 2.13.0+cpu, or a nightly, is what its number says.
    return Requirement(line).specifier.contains(found.split("+")[0], prereleases=True)
