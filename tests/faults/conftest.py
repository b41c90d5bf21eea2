"""One extracted store for all faults, copied for each, and stages as processes of their own.

Where a test needs a process and not an interpreter, `fork` makes one of the `fork_server`.
"""

import importlib
import shutil
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import pytest
import yaml

from pipeline.base.config import Params
from pipeline.extract import extract
from stages.command import run
from tests.extract import conftest as extraction

write_episode = extraction.write_episode
recorded_once = extraction.recorded_once
make_document = extraction.make_document

PACE: dict[str, Any] = {
    "horizon": 3,
    "max_steps": 30,
    "warmup_steps": 3,
    "eval_every": 10,
    "checkpoint_every": 4,
}
"""Of a training that is cut short: long enough for several checkpoints."""
TinyHead = Callable[..., dict[str, Any]]


@pytest.fixture(scope="session")
def extracted(
    make_document: Callable[[Path], dict[str, Any]], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, Any]]:
    """A folder with recordings and the store that was made of them, and its params."""
    folder = tmp_path_factory.mktemp("extracted")
    document = make_document(folder)
    extract(Params.model_validate(document), lambda line: None)
    return folder, document


@pytest.fixture
def document(
    extracted: tuple[Path, dict[str, Any]], tiny_head: TinyHead, tmp_path: Path
) -> dict[str, Any]:
    """The params of a copy of those recordings and of that store, and of a small head."""
    folder, document = extracted
    shutil.copytree(folder / "recordings", tmp_path / "recordings")
    shutil.copytree(folder / "stores", tmp_path / "stores")
    return document | {
        "data": document["data"] | {"root": str(tmp_path / "recordings")},
        "extract": document["extract"] | {"store": str(tmp_path / "stores" / "made.zarr")},
        "train_head": tiny_head(tmp_path, **PACE),
        "evaluate": evaluated(tmp_path),
    }


@pytest.fixture
def store(document: dict[str, Any]) -> Path:
    """The copy of the store."""
    return Path(document["extract"]["store"])


@pytest.fixture
def recordings(document: dict[str, Any]) -> Path:
    """The copy of the recordings."""
    return Path(document["data"]["root"])


@pytest.fixture
def params(document: dict[str, Any], tmp_path: Path) -> Path:
    """params.yaml of these."""
    return write_params(document, tmp_path)


def evaluated(folder: Path) -> dict[str, Any]:
    """The section `evaluate` of the head that is trained in a folder."""
    return {"checkpoint": str(folder / "head"), "output": str(folder / "report"), "device": "cpu"}


def write_params(document: dict[str, Any], folder: Path) -> Path:
    path = folder / "params.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


@pytest.fixture
def head_params(tiny_head: TinyHead, tmp_path: Path) -> Callable[..., Path]:
    """`head_params(store, name, ...)`: params.yaml of a small head on a store."""

    def write(store: Path, name: str = "run", **sections: dict[str, Any]) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        document: dict[str, dict[str, Any]] = {
            "data": {"sources": [{"name": "left", "path": "a"}, {"name": "right", "path": "b"}]},
            "vlm": {"checkpoint": "unused"},
            "extract": {"store": str(store)},
            "train_head": tiny_head(folder, **PACE),
            "evaluate": evaluated(folder),
        }
        for section, values in sections.items():
            document[section] = document.get(section, {}) | values
        return write_params(document, folder)

    return write


Fork = Callable[..., tuple[BaseProcess, Connection]]


@pytest.fixture(scope="session")
def fork(fork_server: ForkServerContext) -> Fork:
    """`fork(work, *arguments)`: a process that does `work(*arguments, told)`, and what it tells.

    `told.send` tells; `work` is a function of a module.
    """

    def begin(work: Callable[..., None], *arguments: Any) -> tuple[BaseProcess, Connection]:
        heard, told = fork_server.Pipe(duplex=False)
        process = fork_server.Process(target=work, args=(*arguments, told))
        process.start()
        told.close()  # so that its end is heard
        return process, heard

    return begin


@pytest.fixture
def here(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """`here("stages.verify", params, *options)`: a stage in this process, which is quicker.

    Exit code, what it said, what it complained of.
    """

    def run_here(name: str, params: Path, *options: str) -> tuple[int, str, str]:
        module = importlib.import_module(name)
        capsys.readouterr()
        arguments = ["--params", str(params), *options]
        code = run("", module.main, arguments, getattr(module, "SHORTHANDS", ()))
        said, complained = capsys.readouterr()
        return code, said, complained

    return run_here
