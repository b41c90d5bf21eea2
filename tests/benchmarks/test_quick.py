"""Every benchmark runs in its quick form, and prints one line of JSON with what was promised."""

import importlib
import json
import runpy
import sys
import tempfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BENCHMARKS = {
    path.stem
    for path in (ROOT / "benchmarks").glob("*.py")
    if '__name__ == "__main__"' in path.read_text(encoding="utf-8")
}
ALONE = "gather"
"""It forks, which a process with the threads of other tests should not: run it by hand."""


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
    out = capfd.readouterr().out
    assert out.count("\n") == 1
    line = json.loads(out)
    assert line["command"] == f"python -m benchmarks.{name} --quick"
    assert line["quick"] is True
    assert line["machine"]["cores"] >= 1
    assert {"settings", "results", "ratios", "targets"} <= set(line)
    for target in line["targets"]:
        assert {"what", "found", "wanted", "reached"} <= set(target)
    assert not list(tmp_path.iterdir()), "it cleans up"
