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

ROOT = Path(__file__).resolve().parents[2]
MACHINERY = ROOT / "docs" / "machinery"


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory, missing: Callable[[str], None]) -> Path:
    """The folder of the built site; a warning fails the build."""
    if shutil.which("mkdocs", path=Path(sys.executable).parent) is None:
        missing("mkdocs is not installed: pip install -e '.[docs]'")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(folder)],
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

    Two episodes a format, a few steps of training: small, but written by the commands themselves.
    """
    folder = tmp_path_factory.mktemp("demo")
    document = yaml.safe_load((ROOT / "params.yaml").read_text(encoding="utf-8"))
    document["demo"]["episodes"] = 2
    document["train_head"] |= {"max_steps": 4, "eval_every": 4, "warmup_steps": 1}
    document["train_head"]["check_store"] = False
    (folder / "params.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    code = (
        "import stages.demo, stages.extract, stages.train_head\n"
        "from pathlib import Path\n"
        "from pipeline.config import load_params\n"
        "params = load_params(Path('params.yaml'))\n"
        "for stage in (stages.demo, stages.extract, stages.train_head): stage.main(params)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder
