"""Packages against the ranges of pyproject.toml."""

import re
from pathlib import Path

import pytest

from pipeline.look.doctor.packages import (
    check_loggers,
    check_python,
    check_required,
    importable,
    read_wanted,
)

PYPROJECT = Path(__file__).resolve().parents[3] / "pyproject.toml"
LOGGERS = ["tensorboard>=2.18", "wandb>=0.19"]


def test_the_projects_own_ranges_hold_here() -> None:
    from pipeline.look.doctor.packages import installed_version

    wanted = read_wanted(PYPROJECT)
    (finding,) = check_required(wanted.packages, installed_version)
    assert finding.level == "ok"
    assert f"{len(wanted.packages)} of {len(wanted.packages)}" in finding.found
    assert re.search(r"torch \d+\.\d+", finding.found)
    assert [re.split("[<>=]", line)[0] for line in wanted.loggers] == ["tensorboard", "wandb"]


def test_a_missing_package_and_an_old_one_are_named_with_what_installs_them() -> None:
    versions = {"torch": "2.13.0+cpu", "zarr": "2.18.0"}
    good, zarr, av = check_required(["torch>=2.6", "zarr>=3.1.6,<4", "av>=15"], versions.get)
    assert good.level == "ok" and "1 of 3" in good.found and "torch 2.13.0+cpu" in good.found
    assert (zarr.level, zarr.found) == ("missing", "expected zarr>=3.1.6,<4, found 2.18.0")
    assert zarr.remedy == "pip install 'zarr>=3.1.6,<4'"
    assert (av.level, av.found) == ("missing", "expected av>=15, found none")


@pytest.mark.parametrize("found", ["2.6.0", "2.13.0+cu126", "2.14.0.dev20260101+rocm6"])
def test_any_build_of_torch_counts_by_its_number(found: str) -> None:
    (finding,) = check_required(["torch>=2.6"], {"torch": found}.get)
    assert finding.level == "ok"


def test_a_logger_is_needed_only_where_the_params_ask_for_it() -> None:
    versions = {"tensorboard": "2.19"}
    unasked = check_loggers(LOGGERS, ("report", "tensorboard"), versions.get)
    assert (unasked.level, unasked.found.split(";")[0]) == ("ok", "wandb not installed")
    asked = check_loggers(LOGGERS, ("wandb",), versions.get)
    assert asked.level == "missing"
    assert "train_head.loggers asks for wandb" in asked.found
    assert "pip install 'vla-feature-cache[loggers]'" in asked.remedy
    assert check_loggers(LOGGERS, ("wandb",), lambda name: "2.20").level == "ok"


def test_python() -> None:
    assert check_python(">=3.11", "3.13.1").level == "ok"
    old = check_python(">=3.11", "3.10.4")
    assert (old.level, old.found) == ("missing", "3.10.4; expected >=3.11")


def test_a_folder_is_no_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "flash_attention_folder").mkdir()
    monkeypatch.syspath_prepend(str(tmp_path))
    assert not importable("flash_attention_folder")
    assert not importable("no_such_module_at_all")
    assert importable("av")
