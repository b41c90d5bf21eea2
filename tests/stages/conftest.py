"""Stages as processes of their own."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from stages import train_head
from stages.command import run

ROOT = Path(__file__).resolve().parents[2]
Process = subprocess.Popen[str]


@pytest.fixture(scope="session")
def flip() -> Callable[[Path, str], Path]:
    """`flip(store, array)`: the chunk file of which one bit was turned; again turns it back."""

    def turn(store: Path, array: str) -> Path:
        (file,) = (one for one in (store / array / "c").rglob("*") if one.is_file())
        content = bytearray(file.read_bytes())
        content[len(content) // 100] ^= 1
        file.write_bytes(content)
        return file

    return turn


@pytest.fixture(scope="session")
def quick_params(
    tiny_store: Callable[..., Path], tiny_head: Callable[..., dict[str, Any]]
) -> Callable[[Path], dict[str, Any]]:
    """`quick_params(folder)`: params of a head that trains in a moment, its tiny store there."""

    def document(folder: Path) -> dict[str, Any]:
        return {
            "data": {"sources": [{"name": "left", "path": "a"}, {"name": "right", "path": "b"}]},
            "vlm": {"checkpoint": "unused"},
            "extract": {"store": str(tiny_store(folder))},
            "train_head": tiny_head(folder),
        }

    return document


@pytest.fixture(scope="session")
def trained_tiny(
    quick_params: Callable[[Path], dict[str, Any]], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A params.yaml whose head is trained on a tiny store."""
    folder = tmp_path_factory.mktemp("tiny")
    judged = {"checkpoint": str(folder / "head"), "output": str(folder / "report")}
    alone = {"environment": None}  # no page of rollouts, to which the way would differ
    document = quick_params(folder) | {"evaluate": judged, "rollout": alone}
    document["export"] = {"output": str(folder / "export")}
    # The last episode is test, and the tail of the others val.
    document["train_head"]["split"] = {"groups": {"rest": ["*_00[0-4]"]}}
    path = folder / "params.yaml"
    path.write_text(yaml.safe_dump(document))
    assert run("", train_head.main, ["--params", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def trained(trained_once: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A params.yaml whose head is trained on two recordings of the phantom."""
    before = trained_once.parent
    folder = Path(shutil.copytree(before, tmp_path_factory.mktemp("trained") / "phantom"))
    path = folder / trained_once.name
    path.write_text(trained_once.read_text().replace(str(before), str(folder)))
    return path


BLOCKER = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in PACKAGES:
            raise ImportError(f"No module named {name!r}")

sys.meta_path.insert(0, Blocker())
"""


@pytest.fixture
def started() -> Callable[..., Process]:
    """`started(code, params, without=packages)`: a process that runs this Python with the file of
    params and cannot import these packages."""

    def start(code: str, params: Path, without: tuple[str, ...]) -> Process:
        return subprocess.Popen(
            [sys.executable, "-c", BLOCKER.replace("PACKAGES", repr(without)) + code, str(params)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
        )

    return start
