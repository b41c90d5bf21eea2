"""A recipe's code, applied to a copy of the project as the page says, keeps the contract.

A block belongs to the file that was named last before it: a `diff` changes it; `python` is a new
file, or stands at the end of one that is there.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
RECIPES = ROOT / "docs" / "recipes"
PART = re.compile(
    r"`(?P<file>(?:pipeline|tests)/[\w/]+\.py)`|^```(?P<kind>python|diff)\n(?P<code>.*?)^```$",
    re.DOTALL | re.MULTILINE,
)


def apply(diff: str, text: str) -> str:
    """The text with a diff without line numbers, whose lines must stand there once."""
    lines = diff.splitlines(keepends=True)
    old, new = ("".join(line[1:] for line in lines if line[0] in kept) for kept in (" -", " +"))
    assert text.count(old) == 1, f"stands there {text.count(old)} times, not once:\n{old}"
    return text.replace(old, new)


def follow(page: Path, project: Path) -> None:
    """Change the project as the page says."""
    place = project
    for part in PART.finditer(page.read_text(encoding="utf-8")):
        if part["file"]:
            place = project / part["file"]
            continue
        text = place.read_text(encoding="utf-8") if place.is_file() else None
        if part["kind"] == "diff":
            assert text is not None, f"{page.name} changes {place}, which is not there"
            text = apply(part["code"], text)
        else:
            text = part["code"] if text is None else f"{text}\n\n{part['code']}"
        place.write_text(text, encoding="utf-8")


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A copy of the code and its tests."""
    without = shutil.ignore_patterns("__pycache__")
    for folder in ("pipeline", "stages", "tests"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=without)
    for name in ("pyproject.toml", "params.yaml"):
        shutil.copy(ROOT / name, tmp_path / name)
    return tmp_path


def passed(project: Path, *arguments: str) -> int:
    """How many tests pass, none of which may fail."""
    # Without what this run was told, such as in how many processes.
    own = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments],
        cwd=project,
        env=own | {"PYTHONPATH": str(project), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    count = re.search(r"(\d+) passed", done.stdout)
    return int(count[1]) if count else 0


def test_the_reader_of_the_recipe_keeps_the_contract(project):
    follow(RECIPES / "reader.md", project)
    assert passed(project, "tests/recordings/test_contract.py", "-k", "trajectory") >= 10


def test_the_expert_of_the_recipe_keeps_the_contract(project):
    follow(RECIPES / "expert.md", project)
    assert passed(project, "tests/models/test_expert.py", "-k", "MLP") >= 20


def test_the_pooling_of_the_recipe_changes_no_other(project, monkeypatch):
    kept = project / "tests/vlm/golden_features.json"
    before = json.loads(kept.read_text(encoding="utf-8"))["features"]
    follow(RECIPES / "pooling.md", project)
    kept.unlink()
    monkeypatch.setenv("WRITE_GOLDEN_FEATURES", "1")
    assert passed(project, "tests/vlm/test_golden_features.py", "tests/vlm/test_pooling.py") >= 5
    after = json.loads(kept.read_text(encoding="utf-8"))["features"]
    new = after.keys() - before.keys()
    assert new
    assert all("pooling=view_centre" in name for name in new)
    assert all(after[name] == pytest.approx(before[name], abs=2e-3) for name in before)


def test_a_page_that_fell_behind_the_code_is_refused():
    assert apply(" a\n-b\n+c\n", "a\nb\nd\n") == "a\nc\nd\n"
    for text in ("a\nd\n", "a\nb\na\nb\n"):
        with pytest.raises(AssertionError, match="not once"):
            apply(" a\n-b\n+c\n", text)
