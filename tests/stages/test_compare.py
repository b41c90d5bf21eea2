"""Evaluations stand in one table only where they were judged on the same things."""

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from pipeline.base.files import MARKER
from pipeline.evaluate.baselines import BASELINES
from pipeline.evaluate.evaluation import JUDGED
from pipeline.evaluate.experiments import read_experiments
from pipeline.look.page import writing
from stages import compare, evaluate, train_head
from stages.command import run

Said = pytest.CaptureFixture[str]

NAMES = ["diffusion-concat", "flow_matching-none", "regression-gated"]


@pytest.fixture(scope="module")
def experiments(
    quick_params: Callable[[Path], dict[str, Any]], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A params.yaml and evaluated experiments."""
    folder = tmp_path_factory.mktemp("compare")
    document = quick_params(folder) | {
        "evaluate": {"modalities": False, "samples": 2},
        "compare": {"reports": str(folder / "reports"), "output": str(folder / "comparison")},
    }
    path = folder / "params.yaml"
    path.write_text(yaml.safe_dump(document))
    for name in NAMES:
        expert, fusion = name.split("-")
        own = [
            f"train_head.model_type={expert}",
            f"train_head.fusion_strategy={fusion}",
            f"train_head.output={folder / 'models' / name}",
            f"train_head.logs={folder / 'logs' / name}",
            f"evaluate.checkpoint={folder / 'models' / name}",
            f"evaluate.output={folder / 'reports' / name}",
        ]
        arguments = ["--params", str(path), *(part for one in own for part in ("--set", one))]
        with pytest.MonkeyPatch.context() as monkeypatch:  # its own page is not what is compared
            monkeypatch.setattr(writing, "write_report", lambda *_: [])
            assert run("", train_head.main, arguments) == 0
            assert run("", evaluate.main, arguments) == 0
    return path


@pytest.fixture
def reports(experiments: Path, tmp_path: Path) -> Path:
    """A copy of the evaluations that a test may spoil."""
    return shutil.copytree(experiments.parent / "reports", tmp_path / "reports")


def refused(reports: Path, experiments: Path, capsys: Said) -> str:
    arguments = ["--params", str(experiments), "--set", f"compare.reports={reports}"]
    assert run("", compare.main, arguments) == 2
    return capsys.readouterr().err


def test_a_table_for_each_span_a_file_and_a_picture(experiments: Path, capsys: Said) -> None:
    assert run("", compare.main, ["--params", str(experiments)]) == 0
    lines = capsys.readouterr().out.splitlines()
    height = 1 + len(NAMES) + len(BASELINES)
    for at, span in ((0, "what is executed"), (height + 2, "the whole chunk")):
        assert f"{span} [training std]" in lines[at]
        assert lines[at].split()[-2:] == ["samples", "parameters"]
        assert [line.split()[0] for line in lines[at + 1 : at + 4]] == NAMES
        assert all(line.startswith("baseline: ") for line in lines[at + 4 : at + height])
        assert lines[at + height].startswith(f"lowest test error of {span}: ")
    output = experiments.parent / "comparison"
    names = ["experiments.csv", "experiments.png", "report.html"]
    assert sorted(path.name for path in output.iterdir()) == [MARKER, *names]
    assert (output / "experiments.png").read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader((output / "experiments.csv").read_text().splitlines()))
    for row in rows:
        folder = experiments.parent / "reports" / row["experiment"]
        metrics = json.loads((folder / "metrics.json").read_text())
        for span, scope in (("executed", "executed"), ("overall", "chunk")):
            policy = metrics[scope]["overall"]["policy"]
            assert float(row[span]) == pytest.approx(policy["value"], rel=1e-4)
        assert row["samples"] == ("1" if row["model_type"] == "regression" else "2")
        assert row["seeds"] == "0"
    page = (output / "report.html").read_text()
    assert all(name in page for name in NAMES)


def test_policies_that_were_sampled_otherwise_are_refused(reports, experiments, capsys):
    path = reports / "diffusion-concat" / JUDGED
    document = json.loads(path.read_text())
    document["drawn"]["batch_size"] = 8
    path.write_text(json.dumps(document))
    error = refused(reports, experiments, capsys)
    assert "batch_size: 8 (diffusion-concat), 64 (flow_matching-none)" in error
    assert "evaluate.samples and evaluate.batch_size" in " ".join(error.split())
    shutil.rmtree(path.parent)
    # What does not sample stands beside any.
    assert len(read_experiments(reports)) == 2


def test_a_folder_that_is_no_evaluation_is_named(reports, experiments, capsys):
    for name, torn in (("groups.csv", "group,policy_executed\na,x\n"), (JUDGED, "{}")):
        file = reports / "regression-gated" / name
        file.unlink()
        assert f"{file}: no such file" in refused(reports, experiments, capsys)
        file.write_text(torn)
        error = refused(reports, experiments, capsys)
        assert f"{file}: " in error
        assert error.count("compare.reports takes the output of stages.evaluate: evaluate") == 1
