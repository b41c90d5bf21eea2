"""The whole command, on this machine and on one where packages are missing."""

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from pipeline.look.doctor import GROUPS
from stages import doctor
from stages.command import run

Start = Callable[..., "subprocess.Popen[str]"]
DOCTOR = """
import sys
from stages import doctor
from stages.command import run

sys.exit(run("", doctor.main, ["--params", sys.argv[1]]))
"""


@pytest.fixture(scope="module")
def params(tmp_path_factory: pytest.TempPathFactory, recorded: Path, demo_checkpoint: Path) -> Path:
    tmp_path = tmp_path_factory.mktemp("doctor")
    document: dict[str, Any] = {
        "data": {"root": str(recorded.parent), "sources": [{"name": "raw", "path": "raw"}]},
        "vlm": {"checkpoint": str(demo_checkpoint), "dtype": "float32"},
        "extract": {"store": str(tmp_path / "made.zarr")},
    }
    path = tmp_path / "params.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def test_where_nothing_is_missing(params: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = set(params.parent.rglob("*"))
    assert run("", doctor.main, ["--params", str(params)]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    lines = captured.out.splitlines()
    assert [line for line in lines if line in GROUPS] == [*GROUPS]
    assert "1 episode(s), raw" in captured.out
    assert lines[-2].startswith("nothing that was looked at is missing")
    assert set(params.parent.rglob("*")) == before, "it changes nothing"


def test_where_packages_are_not_installed(started: Start, params: Path) -> None:
    process = started(DOCTOR, params, without=("torch", "av"))
    out, err = process.communicate(timeout=100)
    assert process.returncode == 2, err
    assert "Traceback" not in err
    assert "cannot be looked at: No module named 'torch'" in out
    assert "cannot be looked at: No module named 'av'" in out
    assert "Recordings" in out
