"""The notebook runs from top to bottom, on the demo and on a path of the user's, and shows what
the page of `stages.inspect` shows."""

import sys
from collections.abc import Callable
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from nbformat import NotebookNode

from pipeline.simulation.demo_recordings import write_demo_recordings

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOK = ROOT / "notebooks" / "check.ipynb"
FIRST = """import sys, warnings
warnings.simplefilter("error")
print(sys.executable)"""
PICTURES_A_RECORDING = 7


def read() -> NotebookNode:
    return nbformat.read(NOTEBOOK, as_version=4)


@pytest.fixture(scope="module")
def project(demo_checkpoint, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the params of this project, a demo of one episode a format and the model."""
    folder = tmp_path_factory.mktemp("project")
    (folder / "notebooks").mkdir()
    (folder / "models").mkdir()
    (folder / "params.yaml").write_text((ROOT / "params.yaml").read_text())
    (folder / "models" / "demo_vlm").symlink_to(demo_checkpoint)
    write_demo_recordings(folder / "data" / "demo", 1, 0)
    return folder


@pytest.fixture
def execute(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[object], list[NotebookNode]]:
    """`execute(recordings)`: the outputs of all cells, run by this very Python.

    Every warning of the project's code is an error there, as it is in tests.
    """
    # Only the kernel that this interpreter brings along, whatever the user has installed.
    monkeypatch.setenv("JUPYTER_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("JUPYTER_RUNTIME_DIR", str(tmp_path / "runtime"))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    monkeypatch.setenv("JUPYTER_PLATFORM_DIRS", "1")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))

    def run(recordings: object) -> list[NotebookNode]:
        notebook = read()
        monkeypatch.setenv("RECORDINGS", str(recordings or ""))
        notebook.cells.insert(0, nbformat.v4.new_code_cell(FIRST))
        resources = {"metadata": {"path": str(project / "notebooks")}}
        client = NotebookClient(notebook, timeout=120, kernel_name="python3", resources=resources)
        client.execute()
        return [one for cell in notebook.cells for one in cell.get("outputs", ())]

    return run


def pictures(outputs: list[NotebookNode]) -> list[NotebookNode]:
    return [one for one in outputs if "image/png" in one.get("data", {})]


def said(outputs: list[NotebookNode], stream: str = "stdout") -> str:
    return "".join(
        one.text for one in outputs if one.output_type == "stream" and one.name == stream
    )


def test_it_is_kept_without_outputs():
    notebook = read()
    for cell in notebook.cells:
        assert not cell.get("outputs") and cell.get("execution_count") is None
    assert notebook.metadata == {"language_info": {"name": "python"}}


def test_it_shows_every_format_of_the_demo(execute):
    outputs = execute(None)
    text = said(outputs)
    assert text.splitlines()[0] == sys.executable
    for source in ("raw", "new", "old", "lerobot"):
        assert f"\n{source}: " in text
    assert "<|vision_start|>" in text and "<|im_end|>" in text and "image tokens:" in text
    assert len(pictures(outputs)) == 4 * PICTURES_A_RECORDING
    assert said(outputs, "stderr") == ""


def test_it_shows_a_path_of_the_users(execute, project):
    outputs = execute(project / "data" / "demo" / "new")
    text = said(outputs)
    assert "\nnew: " in text and "\nraw: " not in text
    assert len(pictures(outputs)) == PICTURES_A_RECORDING
