"""Which packages are installed, against the ranges that this project asks for."""

import re
import sys
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from pipeline.config import Params
from pipeline.machine.findings import Finding, missing, note, ok

PROJECT = "vla-feature-cache"
_SHOWN = ("torch", "transformers", "peft", "zarr", "numpy", "av", "dvc")
_OPTIONAL = {
    "loggers": "train_head.loggers: [tensorboard, wandb]",
    "bench": "the contenders in benchmarks/",
    "test": "python -m pytest",
}
VersionOf = Callable[[str], str | None]


@dataclass(frozen=True)
class Wanted:
    """What the project asks of an environment."""

    python: str
    """Range of versions."""
    packages: Sequence[str]
    """Requirements, as in pyproject.toml."""
    extras: Mapping[str, Sequence[str]]


def check_packages(params: Params) -> list[Finding]:
    """Python, the packages that are needed and the optional ones, as they are here."""
    wanted = read_wanted(Path(__file__).parents[2] / "pyproject.toml")
    python = ".".join(map(str, sys.version_info[:3]))
    return [
        check_python(wanted.python, python),
        *check_required(wanted.packages, installed_version),
        *check_optional(wanted.extras, params.train_head.loggers, installed_version),
    ]


def read_wanted(pyproject: Path) -> Wanted:
    """What pyproject.toml of the checkout says: what was installed may be older than it."""
    project: dict[str, Any] = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    return Wanted(
        project["requires-python"], project["dependencies"], project["optional-dependencies"]
    )


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


def check_optional(
    extras: Mapping[str, Sequence[str]], loggers: Sequence[str], version_of: VersionOf
) -> list[Finding]:
    """What the extras add; a logger that the params ask for is needed."""
    findings: list[Finding] = []
    for extra, use in _OPTIONAL.items():
        lines = [line for line in extras.get(extra, ()) if not line.startswith(PROJECT)]
        absent = [line for line in lines if not _fits(line, version_of(Requirement(line).name))]
        names = [re.split(r"[<>=!~\[; ]", line)[0] for line in absent]
        remedy = f"pip install '{PROJECT}[{extra}]', or in a checkout: pip install -e '.[{extra}]'"
        if not absent:
            findings.append(ok(f"[{extra}]", f"installed, for {use}"))
        elif extra == "loggers" and (asked := sorted({*names} & {*loggers})):
            said = f"train_head.loggers asks for {', '.join(asked)}, which is not installed"
            findings.append(missing("[loggers]", said, remedy))
        else:
            said = f"optional, for {use}; not installed: {', '.join(names)}"
            findings.append(note(f"[{extra}]", said, remedy))
    return findings


def importable(name: str) -> bool:
    """Whether a module of this name is installed; a bare folder is none."""
    spec = find_spec(name)
    return spec is not None and spec.origin is not None


def _fits(line: str, found: str | None) -> bool:
    if found is None:
        return False
    # A build such as 2.13.0+cpu, or a nightly, is what its number says.
    return Requirement(line).specifier.contains(found.split("+")[0], prereleases=True)
