"""The site as a reader gets it, and a small demo to try snippets on."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest
import yaml

import stages.demo
import stages.extract
import stages.train_head
from pipeline.base.config import load_params

ROOT = Path(__file__).resolve().parents[2]
MACHINERY = ROOT / "docs" / "machinery"
PAGES = [
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted(ROOT.glob("README*.md")),
    ROOT / "CONTRIBUTING.md",
    ROOT / "cache_store" / "README.md",
]
"""What the documentation consists of."""


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the built site; a warning fails the build."""
    if shutil.which("mkdocs", path=Path(sys.executable).parent) is None:
        pytest.skip("mkdocs is not installed: pip install -e '.[docs]'")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(folder)],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1", "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="session")
def machinery() -> Iterator[Callable[[str], ModuleType]]:
    """`machinery(name)`: a module of what builds the site, as MkDocs imports it."""
    before = list(sys.path)
    sys.path.insert(0, str(MACHINERY))
    yield __import__
    sys.path[:] = before


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as a quick start leaves it: params.yaml, recordings, checkpoint, store, head.

    Two episodes of two formats in the store, a few steps of training: small, but written by the
    commands themselves.
    """
    folder = tmp_path_factory.mktemp("demo")
    document = yaml.safe_load((ROOT / "params.yaml").read_text(encoding="utf-8"))
    document["demo"]["episodes"] = 2
    document["data"]["sources"] = [{"name": name, "path": name} for name in ("new", "old")]
    document["train_head"] |= {"max_steps": 4, "eval_every": 4, "warmup_steps": 1}
    document["train_head"]["check_store"] = document["evaluate"]["check_store"] = False
    (folder / "params.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    with pytest.MonkeyPatch.context() as patched:
        patched.chdir(folder)
        params = load_params(Path("params.yaml"))
        for stage in (stages.demo, stages.extract, stages.train_head):
            stage.main(params)
    return folder
