"""Every benchmark runs in its quick form, and prints one line of JSON with what was promised."""

import importlib
import json
import os
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
BENCHMARKS = {
    path.stem
    for path in (ROOT / "benchmarks").glob("*.py")
    if '__name__ == "__main__"' in path.read_text(encoding="utf-8")
}
ALONE = "gather"
"""It forks, which a process with the threads of other tests should not."""


def assert_is_a_report(out: str, name: str) -> None:
    assert out.count("\n") == 1
    line: dict[str, Any] = json.loads(out)
    assert line["command"] == f"python -m benchmarks.{name} --quick"
    assert line["quick"] is True
    assert line["machine"]["cores"] >= 1
    assert {"settings", "results", "ratios", "targets"} <= set(line)
    for target in line["targets"]:
        assert {"what", "found", "wanted", "reached"} <= set(target)


SLOW = {"extract", "head_latency", "reading", "robot_jitter", "slots"}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else [])
        for name in sorted(BENCHMARKS - {ALONE})
    ],
)
def test_a_quick_run_prints_one_line_of_json(name, tmp_path, monkeypatch, capfd):
    # Its first import, which a benchmark may be, makes a cache folder where temporary files go.
    importlib.import_module("torch._dynamo")
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["benchmarks", "--quick"])
    # runpy warns of a module that another test has imported.
    monkeypatch.delitem(sys.modules, f"benchmarks.{name}", raising=False)
    runpy.run_module(f"benchmarks.{name}", run_name="__main__", alter_sys=True)
    assert_is_a_report(capfd.readouterr().out, name)
    assert not list(tmp_path.iterdir()), "it cleans up"


@pytest.mark.slow
@pytest.mark.extra
def test_the_command_that_a_report_names_is_that_of_its_run(tmp_path):
    for contender in ("h5py", "lmdb", "tensorstore"):
        pytest.importorskip(
            contender, reason=f"{contender} is not installed: pip install -e '.[bench]'"
        )
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{ALONE}", "--quick"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"TMPDIR": str(tmp_path)},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert_is_a_report(done.stdout, ALONE)
