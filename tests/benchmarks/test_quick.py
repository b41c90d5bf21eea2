"""Every benchmark runs in its quick form, and prints one line of JSON with what was promised."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BENCHMARKS = sorted(
    path.stem
    for path in (ROOT / "benchmarks").glob("*.py")
    if '__name__ == "__main__"' in path.read_text(encoding="utf-8")
)


@pytest.mark.parametrize("name", BENCHMARKS)
def test_a_quick_run_prints_one_line_of_json(name, tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{name}", "--quick"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"TMPDIR": str(tmp_path), "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.count("\n") == 1
    line = json.loads(done.stdout)
    assert line["command"] == f"python -m benchmarks.{name} --quick"
    assert line["quick"] is True
    assert line["machine"]["cores"] >= 1
    assert {"settings", "results", "ratios", "targets"} <= set(line)
    for target in line["targets"]:
        assert {"what", "found", "wanted", "reached"} <= set(target)
