"""Packages against the ranges of pyproject.toml, and how issues read."""

import re
from types import SimpleNamespace
from typing import Any

import pytest

from pipeline.base.config import Params
from pipeline.base.errors import ConfigError
from pipeline.look import doctor as machine
from pipeline.look.doctor import (
    WIDTH,
    check_packages,
    check_required,
    describe,
    installed_version,
    missing,
    note,
    ok,
)


def test_the_projects_own_ranges_hold_here() -> None:
    document = {"data": {"sources": [{"name": "a", "path": "."}]}, "vlm": {"checkpoint": "a/b"}}
    (issue,) = check_packages(Params.model_validate(document))
    assert issue.severity == "ok"
    assert re.search(r"(\d+) of \1 .*python 3\.\d+.*, torch \d+\.\d+", issue.message)
    assert installed_version("no-such-package-at-all") is None


def test_a_logger_is_needed_only_where_the_params_ask_for_it() -> None:
    document = {
        "data": {"sources": [{"name": "a", "path": "."}]},
        "vlm": {"checkpoint": "a/b"},
        "train_head": {"loggers": ["wandb"]},
    }
    issues = {issue.kind for issue in check_packages(Params.model_validate(document))}
    assert ("wandb" in issues) == (installed_version("wandb") is None)
    assert "tensorboard" not in issues


def test_a_missing_package_and_an_old_one_are_named_with_what_installs_them() -> None:
    versions = {"torch": "2.13.0+cpu", "zarr": "2.18.0", "python": "3.10.4"}
    lines = ["python>=3.11", "torch>=2.6", "zarr<4,>=3.1.6", "av>=15"]
    good, python, zarr, av = check_required(lines, versions.get)
    assert good.severity == "ok" and "1 of 4" in good.message
    assert "torch 2.13.0+cpu" in good.message
    assert (zarr.severity, zarr.message) == ("error", "expected zarr<4,>=3.1.6, found 2.18.0")
    assert zarr.remedy == "pip install 'zarr<4,>=3.1.6'"
    assert (av.severity, av.message) == ("error", "expected av>=15, found none")
    assert (python.severity, "environment" in python.remedy) == ("error", True)


@pytest.mark.parametrize("found", ["2.6.0", "2.13.0+cu126", "2.14.0.dev20260101+rocm6"])
def test_any_build_of_torch_counts_by_its_number(found: str) -> None:
    (issue,) = check_required(["torch>=2.6"], {"torch": found}.get)
    assert issue.severity == "ok"


@pytest.fixture
def params() -> Params:
    return Params.model_validate(
        {"data": {"sources": [{"name": "a", "path": "."}]}, "vlm": {"checkpoint": "x/y"}}
    )


def test_lines_stay_within_the_width_and_words_whole() -> None:
    command = "pip install --force-reinstall torch --index-url https://a.example/" + "x" * 20
    lines = describe("A group", [ok("subject", "word " * 40), note("other", "found", command)])
    assert lines[0] == "A group" and lines[-1] == ""
    assert all(len(line) <= WIDTH for line in lines)
    assert sum(line.startswith("  ok ") for line in lines) == 1
    assert "https://a.example/" + "x" * 20 in "\n".join(lines)
    starts = {line.index("word") for line in lines if "word" in line}
    assert starts == {30}, "found stands in one column"


def _refuse(params: Params) -> None:
    raise ConfigError("device: cuda:7")


@pytest.mark.parametrize(
    ("check", "said"),
    [
        (ImportError("No module named 'av'"), "No module named 'av'"),
        (_refuse, "device: cuda:7"),
        (lambda params: [missing("it", "is not there", "get it")], "is not there"),
    ],
)
def test_what_cannot_be_looked_at_is_an_issue(params, monkeypatch, check, said):
    def load(name: str) -> Any:
        if isinstance(check, Exception):
            raise check
        return SimpleNamespace(check=check)

    monkeypatch.setattr(machine, "import_module", load)
    monkeypatch.setattr(machine, "GROUPS", {"A group": ("one", "check")})
    ((title, (issue,)),) = machine.examine(params)
    assert (title, issue.severity) == ("A group", "error")
    assert said in issue.message
