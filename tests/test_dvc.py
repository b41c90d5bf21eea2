"""What re-runs when what changes: the pipeline in a copy of the project, with tiny params.

Whole runs are slow ones: `.ci/run` has `dvc repro` twice, as the README types it.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from pipeline.base.config import load_params
from pipeline.store import FeatureStore

ROOT = Path(__file__).resolve().parents[1]

TINY = {
    "demo": {"episodes": 2},
    "data": {"vlm_reuse_count": 9},
    "vlm": {"image_resize_height": 56, "image_resize_width": 56, "pooling": ["mean"]},
    "train_head": {"max_steps": 6, "eval_every": 3, "checkpoint_every": 3, "warmup_steps": 1},
    "rollout": {"episodes": 1, "ablations": []},
}
NOTES = ("params.yaml", "dvc.lock")


class Project:
    """A copy of the project with its own repository."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        tracked = self._git(ROOT, "ls-files", "-co", "--exclude-standard", "-z").split("\0")
        for name in filter(None, tracked):
            if (ROOT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, folder / name)
        self._git(folder, "init", "-q")
        self._git(folder, "add", "-A")
        identity = ("-c", "user.name=test", "-c", "user.email=test@localhost")
        self._git(folder, *identity, "commit", "-qm", "copy")

    def set(self, **sections: dict) -> None:
        path = self.folder / "params.yaml"
        document = yaml.safe_load(path.read_text())
        for section, values in sections.items():
            document[section] |= values
        path.write_text(yaml.safe_dump(document, sort_keys=False))

    def dvc(self, *arguments: str, code: int = 0) -> str:
        paths = [str(Path(sys.executable).parent), os.environ["PATH"]]
        done = subprocess.run(
            [sys.executable, "-m", "dvc", *arguments],
            cwd=self.folder,
            capture_output=True,
            text=True,
            check=False,
            env={
                **os.environ,
                "PATH": os.pathsep.join(paths),
                "PYTHONPATH": str(self.folder),
                "DVC_NO_ANALYTICS": "1",
                # What it remembers of files goes by path, inode and time of change, which a folder
                # of an earlier run of the tests may have had too.
                "DVC_SITE_CACHE_DIR": str(self.folder.with_name(f"{self.folder.name}_dvc")),
            },
        )
        assert done.returncode == code, done.stdout + done.stderr
        return done.stdout + done.stderr * (code != 0)

    def stale(self) -> dict[str, list]:
        """The stages whose own params, code or data changed."""
        return json.loads(self.dvc("status", "dvc.yaml", "--json"))

    def _git(self, folder: Path, *arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments], cwd=folder, check=True, capture_output=True, text=True
        ).stdout


def copied(folder: Path) -> Project:
    """A copy of the project with tiny params."""
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("needs git and the project's own repository")
    made = Project(folder)
    made.set(**TINY)
    return made


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory: pytest.TempPathFactory) -> Project:
    """The project after one `dvc repro`."""
    made = copied(tmp_path_factory.mktemp("project"))
    made.dvc("repro")
    return made


@pytest.fixture
def project(reproduced: Project) -> Iterator[Project]:
    """The project after `dvc repro`; what a test sets, and what DVC notes of it, is undone."""
    notes = {path: path.read_bytes() for path in map(reproduced.folder.joinpath, NOTES)}
    yield reproduced
    for path, content in notes.items():
        path.write_bytes(content)


def test_dvc_removes_no_output_that_a_param_names():
    """Only the stage knows whether what lies there is its own."""
    stages = yaml.safe_load((ROOT / "dvc.yaml").read_text())["stages"]
    outs = [out for stage in stages.values() for out in stage["outs"]]
    assert outs and all([*settings.values()] == [{"persist": True}] for settings in outs)


def test_no_other_pipeline_claims_outputs():
    """DVC collects every dvc.yaml of a repository, and `dvc exp run` removes what they claim."""
    tracked = subprocess.run(
        ["git", "ls-files", "*dvc.yaml", "*.dvc"], cwd=ROOT, capture_output=True, text=True
    ).stdout
    assert tracked.split() in ([], ["dvc.yaml"])


@pytest.mark.slow
def test_a_folder_of_the_user_survives_a_param_that_names_it(project):
    thesis = project.folder / "notes/thesis.txt"
    thesis.parent.mkdir(exist_ok=True)
    thesis.write_text("mine")
    try:
        project.set(evaluate={"output": "notes"})
        assert "move it away" in project.dvc("repro", "-s", "evaluate", code=255)
        assert thesis.read_text() == "mine"
    finally:
        shutil.rmtree(thesis.parent)


@pytest.mark.slow
def test_code_that_changed_trains_a_finished_run_again(project):
    shown = project.dvc("repro", "-f", "-s", "train_head")
    assert "holds this very run; it is replaced" in shown
    assert "best and last checkpoint" in shown


def test_what_is_judged_is_what_was_trained():
    """An older head, named by a key of its own, would be judged when `train_head.output` moves."""
    evaluate = yaml.safe_load((ROOT / "dvc.yaml").read_text())["stages"]["evaluate"]
    assert "${train_head.output}" in evaluate["deps"]
    assert yaml.safe_load((ROOT / "params.yaml").read_text())["evaluate"]["checkpoint"] is None


@pytest.mark.slow
def test_a_second_run_does_nothing(project):
    assert project.stale() == {}  # says what changed, where something did
    assert "Data and pipelines are up to date." in project.dvc("repro")


@pytest.mark.slow
def test_metrics_and_plots_are_declared(project):
    shown = json.loads(project.dvc("metrics", "show", "--json"))
    evaluated, rolled_out = (
        shown[""]["data"][f"reports/{stage}/headline.json"]["data"]
        for stage in ("evaluate", "rollout")
    )
    assert len(evaluated) == 4 and rolled_out.keys() == {"success"}
    metrics = json.loads((project.folder / "reports/evaluate/metrics.json").read_text())
    assert evaluated["executed_error"] == metrics["executed"]["overall"]["policy"]["value"]
    assert (project.folder / "reports/evaluate/horizon.png").exists()


def test_a_param_makes_its_own_stage_stale_and_none_before(tmp_path):
    """Of what lies there DVC asks only whether it changed: files of any content stand for it."""
    project = copied(tmp_path)
    document = yaml.safe_load((project.folder / "dvc.yaml").read_text())["stages"]
    params = load_params(project.folder / "params.yaml").model_dump()
    for out in (next(iter(out)) for stage in document.values() for out in stage["outs"]):
        named = re.sub(r"\$\{(\w+)\.(\w+)\}", lambda m: str(params[m[1]][m[2]]), out)
        (project.folder / named).mkdir(parents=True, exist_ok=True)
        (project.folder / named / "made").write_text(named)
    project.dvc("commit", "--force")
    project.set(extract={"batch_size": 3, "decode_threads": 1})
    assert project.stale() == {}
    project.set(
        vlm={"prompt": "{images}{instruction}"},
        extract={"dtype": "float16"},
        train_head={"lr": 0.123},
        evaluate={"batch_size": 3},
        rollout={"seed": 3},
    )
    changed = {
        stage: set(said["changed deps"]["params.yaml"])
        for stage, (said, *_) in project.stale().items()
    }
    assert changed == {
        "extract": {"vlm", "extract.dtype"},
        "train_head": {"train_head"},
        "evaluate": {"evaluate"},
        "rollout": {"rollout"},
    }


@pytest.mark.slow
def test_own_data_leave_the_demo_alone_and_an_added_episode_computes_its_rows(project, tmp_path):
    own = tmp_path / "own"
    shutil.copytree(project.folder / "data/demo/raw", own / "task" / "raw")
    sources = [{"name": "mine", "path": "task/raw"}]
    project.set(
        data={"root": str(own), "sources": sources}, extract={"store": "cache_store/own.zarr"}
    )
    said = project.dvc("repro", "extract")
    assert "Running stage 'extract'" in said
    assert "Running stage 'demo'" not in said
    rows = len(FeatureStore.open(project.folder / "cache_store/own.zarr").array("vl/time"))

    episode = next((own / "task/raw").glob("*/*"))
    added = episode.with_name("data_collection_20300101_000000")
    shutil.copytree(episode, added)
    image = next(added.glob("View1/**/*.jpg"))
    shutil.copy(sorted(added.glob("View2/**/*.jpg"))[0], image)
    said = project.dvc("repro", "extract")
    store = FeatureStore.open(project.folder / "cache_store/own.zarr")
    assert len(store.episodes) == 3
    line = next(text for text in said.splitlines() if "taken over" in text)
    counts = re.search(r"(\d+) computed.*, (\d+) taken over", line)
    assert counts, line
    assert int(counts[1]) <= len(store.episodes[-1].vl_rows)
    assert int(counts[2]) >= rows
