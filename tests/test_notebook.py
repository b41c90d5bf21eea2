"""The notebook runs from top to bottom, on the demo and on a path of the user's, and shows what
the page of `stages.inspect` shows."""

import sys
from dataclasses import dataclass
from pathlib import Path

import nbformat
import pytest
import yaml
from nbclient import NotebookClient
from nbformat import NotebookNode

from pipeline.simulation.demo_recordings import write_demo_recordings

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOK = ROOT / "notebooks" / "check.ipynb"
FIRST = """import sys, warnings
warnings.simplefilter("error")
print(sys.executable)"""
PICTURES_A_RECORDING = 5
SOURCES = ("raw", "lerobot")


def read() -> NotebookNode:
    return nbformat.read(NOTEBOOK, as_version=4)


@dataclass(frozen=True)
class Shown:
    """What cells have shown: of the demo, and of a path of the user's."""

    demo: list[NotebookNode]
    own: list[NotebookNode]


@pytest.fixture(scope="module")
def shown(demo_checkpoint, tmp_path_factory: pytest.TempPathFactory) -> Shown:
    """The outputs of all cells, run by this very Python in a folder of a project.

    One kernel runs them on the demo, of an episode of two formats, and then on a path. Every
    warning of the project's code is an error there, as it is in tests.
    """
    folder = tmp_path_factory.mktemp("project")
    (folder / "notebooks").mkdir()
    (folder / "models").mkdir()
    params = yaml.safe_load((ROOT / "params.yaml").read_text(encoding="utf-8"))
    params["inspect"] = {"samples": 1, "ticks": 1}
    params["data"]["sources"] = [{"name": name, "path": name} for name in SOURCES]
    (folder / "params.yaml").write_text(yaml.safe_dump(params), encoding="utf-8")
    (folder / "models" / "demo_vlm").symlink_to(demo_checkpoint)
    write_demo_recordings(folder / "data" / "demo", 1, 0)

    own = read().cells
    path = str(folder / "data" / "demo" / "old")
    own.insert(0, nbformat.v4.new_code_cell(f"os.environ['RECORDINGS'] = {path!r}"))
    notebook = read()
    notebook.cells.insert(0, nbformat.v4.new_code_cell(FIRST))
    of_demo = len(notebook.cells)
    notebook.cells += own
    resources = {"metadata": {"path": str(folder / "notebooks")}}
    with pytest.MonkeyPatch.context() as patched:
        # Only the kernel that this interpreter brings along, whatever the user has installed.
        patched.setenv("JUPYTER_DATA_DIR", str(folder / "jupyter"))
        patched.setenv("JUPYTER_RUNTIME_DIR", str(folder / "runtime"))
        patched.setenv("IPYTHONDIR", str(folder / "ipython"))
        patched.setenv("JUPYTER_PLATFORM_DIRS", "1")
        patched.setenv("PYTHONPATH", str(ROOT))
        patched.setenv("RECORDINGS", "")
        NotebookClient(notebook, timeout=250, kernel_name="python3", resources=resources).execute()
    return Shown(outputs(notebook.cells[:of_demo]), outputs(notebook.cells[of_demo:]))


def outputs(cells: list[NotebookNode]) -> list[NotebookNode]:
    return [one for cell in cells for one in cell.get("outputs", ())]


def pictures(shown: list[NotebookNode]) -> list[NotebookNode]:
    return [one for one in shown if "image/png" in one.get("data", {})]


def said(shown: list[NotebookNode], stream: str = "stdout") -> str:
    return "".join(one.text for one in shown if one.output_type == "stream" and one.name == stream)


def test_it_is_kept_without_outputs():
    notebook = read()
    for cell in notebook.cells:
        assert not cell.get("outputs") and cell.get("execution_count") is None
    assert notebook.metadata == {"language_info": {"name": "python"}}


def test_it_shows_every_source_of_the_demo(shown):
    text = said(shown.demo)
    assert text.splitlines()[0] == sys.executable
    for source in SOURCES:
        assert f"\n{source}: " in text
    assert "<|vision_start|>" in text and "<|im_end|>" in text and "image tokens" in text
    assert len(pictures(shown.demo)) == len(SOURCES) * PICTURES_A_RECORDING
    assert said(shown.demo, "stderr") == ""


def test_it_shows_a_path_of_the_users(shown):
    text = said(shown.own)
    assert "\nold: " in text and "\nraw: " not in text
    assert len(pictures(shown.own)) == PICTURES_A_RECORDING
    assert said(shown.own, "stderr") == ""
