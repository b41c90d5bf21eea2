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
GOLDEN = Path("tests/vlm/golden_features.json")
TESTS = (
    "tests/data/test_contract.py",
    "tests/policy/test_expert.py",
    "tests/vlm/test_golden_features.py",
    "tests/vlm/test_pooling.py",
)
ASKED = "trajectory or MLP or golden or pooling"
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
    parts = [*PART.finditer(page.read_text(encoding="utf-8"))]
    assert parts
    for part in parts:
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


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One copy for all recipes: each is then also tried beside the others."""
    project = tmp_path_factory.mktemp("project")
    without = shutil.ignore_patterns("__pycache__")
    for folder in ("pipeline", "stages", "tests"):
        shutil.copytree(ROOT / folder, project / folder, ignore=without)
    for name in ("pyproject.toml", "params.yaml"):
        shutil.copy(ROOT / name, project / name)
    for page in ("reader", "expert", "pooling"):
        follow(RECIPES / f"{page}.md", project)
    return project


@pytest.fixture(scope="module")
def said(project: Path) -> str:
    """What the tests of the copy say, with the names of those that pass; none of them fails."""
    (project / GOLDEN).unlink()
    # Without what this run was told, such as which of several processes it is.
    own = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    told = {"PYTHONPATH": str(project), "PYTHONDONTWRITEBYTECODE": "1"}
    told |= {"WRITE_GOLDEN_FEATURES": "1"}
    options = ["-q", "-rp", "-n0", "-p", "no:cacheprovider", "--color=no"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, *TESTS, "-k", ASKED],
        cwd=project,
        env=own | told,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_every_recipe_still_fits_the_code(project: Path) -> None:
    assert len([path for path in project.rglob("*.py") if compile(path.read_bytes(), path, "exec")])


@pytest.mark.slow
def test_the_reader_of_the_recipe_keeps_the_contract(said):
    assert said.count("PASSED tests/data/test_contract.py::") >= 10


@pytest.mark.slow
def test_the_expert_of_the_recipe_keeps_the_contract(said):
    assert said.count("PASSED tests/policy/test_expert.py::") >= 20


@pytest.mark.slow
def test_the_pooling_of_the_recipe_changes_no_other(said, project):
    assert said.count("PASSED tests/vlm/test_") >= 5
    before = json.loads((ROOT / GOLDEN).read_text(encoding="utf-8"))["features"]
    after = json.loads((project / GOLDEN).read_text(encoding="utf-8"))["features"]
    new = after.keys() - before.keys()
    assert new
    assert all("pooling=view_centre" in name for name in new)
    assert all(after[name] == pytest.approx(before[name], abs=2e-3) for name in before)
