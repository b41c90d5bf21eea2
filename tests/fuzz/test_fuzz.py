"""Whatever is done to a file, a command gives the right data or says what to do."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def run_suite(*options: str) -> None:
    """Run the suite in a process that can fork: this one has threads."""
    command = [sys.executable, "-m", "tests.fuzz.table", *options]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.stderr[-20_000:]}\n{done.stdout[-2_000:]}"


def test_cases_of_every_class() -> None:
    run_suite("--cases", "19")


@pytest.mark.slow
@pytest.mark.timeout(4 * 3600)
def test_ten_thousand_cases() -> None:
    run_suite("--cases", "10000", "--seed", "1")
