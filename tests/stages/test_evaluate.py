"""The command refuses a checkpoint and a store that do not belong together."""

import json
import re
import shutil
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
import yaml

from pipeline.look.page import writing
from pipeline.look.page.blocks import Picture, Report, Text
from pipeline.store.chunks import write_seal
from stages import evaluate, train_head
from stages.command import run

ROOT = Path(__file__).resolve().parents[2]
PICTURES = (
    "curves",
    "dimension_horizon",
    "episode_worst",
    "horizon",
    "methods",
    "modalities",
    "scatter",
)
"""Of one test episode, which is the worst, and of which dvc.yaml lists some."""


@pytest.fixture(scope="module")
def trained(
    quick_params: Callable[[Path], dict[str, Any]], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A params.yaml whose head is trained."""
    folder = tmp_path_factory.mktemp("evaluate")
    judged = {"checkpoint": str(folder / "head"), "output": str(folder / "report")}
    alone = {"environment": None}  # no page of rollouts, to which the way would differ
    document = quick_params(folder) | {"evaluate": judged, "rollout": alone}
    # The last episode is test, and the tail of the others val.
    document["train_head"]["split"] = {"groups": {"rest": ["*_00[0-4]"]}}
    path = folder / "params.yaml"
    path.write_text(yaml.safe_dump(document))
    assert run("", train_head.main, ["--params", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def judged(trained: Path) -> tuple[Path, str]:
    """Where its evaluation lies, whole, and what was said; not to be written to."""
    said = StringIO()
    with redirect_stdout(said):
        assert run("", evaluate.main, ["--params", str(trained)]) == 0
    return trained.parent / "report", said.getvalue()


@pytest.fixture
def reports(monkeypatch: pytest.MonkeyPatch) -> list[Report]:
    """The pages that evaluations here would write: most of their time goes into pictures."""
    found: list[Report] = []

    def kept(folder: Path, report: Report) -> list[Path]:
        found.append(report)
        return []

    monkeypatch.setattr(writing, "write_report", kept)
    return found


def arguments(trained: Path, output: Path, *overrides: str) -> list[str]:
    """Of an evaluation into `output` that leaves the streams alone."""
    told = (f"evaluate.output={output}", "evaluate.modalities=false", *overrides)
    return ["--params", str(trained), *(part for one in told for part in ("--set", one))]


@pytest.mark.usefixtures("reports")
def test_a_store_that_grew_is_judged_on_the_same_episodes(trained, judged, tiny_store, tmp_path):
    report, said = judged
    assert "30 test ticks of 1 episode(s)" in said
    grown = f"evaluate.store={tiny_store(tmp_path, episodes=9)}"
    assert run("", evaluate.main, arguments(trained, tmp_path / "report", grown)) == 0
    assert (tmp_path / "report/judged.json").read_bytes() == (report / "judged.json").read_bytes()


@pytest.mark.usefixtures("reports")
def test_a_flipped_bit_is_refused_where_it_would_be_judged_on(
    trained, tiny_store, flip, tmp_path, capsys
):
    store = tiny_store(tmp_path, name="flipped")
    file = flip(store, "vl/features")
    told = arguments(trained, tmp_path / "report", f"evaluate.store={store}")
    assert run("", evaluate.main, told) == 2
    assert f"{file}: " in capsys.readouterr().err
    assert not (tmp_path / "report").exists()
    assert run("", evaluate.main, [*told, "--set", "evaluate.check_store=false"]) == 0


def test_what_cannot_be_evaluated_says_what_to_do(trained, tmp_path, capsys):
    for override, message in (
        (f"evaluate.checkpoint={tmp_path / 'nowhere'}", "Run stages.train_head"),
        ("evaluate.execute=9", "evaluate.execute 9: expected at most the 8 steps"),
    ):
        assert run("", evaluate.main, arguments(trained, tmp_path / "report", override)) == 2
        assert message in capsys.readouterr().err


@pytest.mark.usefixtures("reports")
def test_without_a_checkpoint_it_judges_what_train_head_wrote(
    trained, tmp_path, monkeypatch, capsys
):
    """Not an older head that lies where heads lie by default."""
    shutil.copytree(trained.parent / "head", tmp_path / "models/head")
    monkeypatch.chdir(tmp_path)
    document = yaml.safe_load(trained.read_text())
    del document["evaluate"]["checkpoint"]
    params = tmp_path / "params.yaml"
    params.write_text(yaml.safe_dump(document))
    assert run("", evaluate.main, arguments(params, tmp_path / "report")) == 0
    assert f"{trained.parent / 'head'} (step 3)" in capsys.readouterr().out


@pytest.mark.usefixtures("reports")
def test_a_policy_outlives_the_renaming_of_its_source(trained, judged, tmp_path, capsys):
    renamed = Path(shutil.copytree(trained.parent / "tiny.zarr", tmp_path / "renamed.zarr"))
    document = json.loads((renamed / "zarr.json").read_text())
    document["attributes"]["sources"] = ["gauche", "droite"]
    (renamed / "zarr.json").write_text(json.dumps(document))
    write_seal(renamed)
    told = arguments(trained, tmp_path / "report", f"evaluate.store={renamed}")
    assert run("", evaluate.main, told) == 0
    assert "renamed since the training" in capsys.readouterr().out
    before, after = (
        json.loads((folder / "metrics.json").read_text())
        for folder in (judged[0], tmp_path / "report")
    )
    assert after == before


def test_the_report_says_what_was_judged_and_which_streams_are_used(judged):
    """One test episode: nothing can be shuffled or drawn anew, and the report says so."""
    report, said = judged
    assert "sensor    zeroed" in said
    assert "sensor shuffled: not judged" in said and "intervals take at least two" in said
    for name in PICTURES:
        assert (report / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert "\nsensor delayed 50 ms," in (report / "streams.csv").read_text()
    document = json.loads((report / "judged.json").read_text())
    assert document["policy"]["model_type"] == "regression"
    assert document["policy"]["samples"] == 1
    assert document["drawn"] is None
    name, tested = next(iter(document["on"]["test"].items()))
    assert tested["ticks"] == [0, 30] and tested["group"] == name
    assert document["on"]["execute"] == 1
    place = f"data/demo/recordings/{name.split('/')[1]}"
    page = (report / "report.html").read_text()
    assert f"No frames: there is no recording at {place} any more." in page


def test_the_same_judgement_is_the_same_bytes_wherever_it_is_written(trained, judged, tmp_path):
    output = f"evaluate.output={tmp_path / 'else' / 'where'}"
    assert run("", evaluate.main, ["--params", str(trained), "--set", output]) == 0
    first, second = (
        {file.name: file.read_bytes() for file in folder.iterdir()}
        for folder in (judged[0], tmp_path / "else" / "where")
    )
    assert first == second and "report.html" in first


def test_a_report_says_that_the_logs_are_gone(trained, tmp_path, reports):
    logs = shutil.move(trained.parent / "logs", tmp_path / "logs")
    try:
        assert run("", evaluate.main, arguments(trained, tmp_path / "report")) == 0
    finally:
        shutil.move(logs, trained.parent / "logs")
    (report,) = reports
    gone = f"there are none in {trained.parent / 'logs/plots/metrics'} any more"
    assert any(gone in text.words for text in report.blocks(Text))
    assert "curves" not in {picture.name for picture in report.blocks(Picture)}


def test_streams_are_left_alone_where_nobody_asks(trained, tmp_path, reports):
    """DVC misses no file of such an evaluation either."""
    listed = re.findall(r"evaluate\.output}/([\w.]+)", (ROOT / "dvc.yaml").read_text())
    output = tmp_path / "report"
    assert run("", evaluate.main, arguments(trained, output)) == 0
    pictures = {f"{picture.name}.png" for picture in reports[0].blocks(Picture)}
    assert len(listed) > 8 and set(listed) <= pictures | {file.name for file in output.iterdir()}
    assert "modalities.png" not in pictures
    assert (output / "streams.csv").read_text().count("\n") == 1


@pytest.mark.usefixtures("reports")
def test_a_sampling_policy_is_judged_on_one_sample(trained: Path, tmp_path: Path) -> None:
    head = tmp_path / "head"
    own = (
        "train_head.model_type=flow_matching",
        f"train_head.output={head}",
        f"train_head.logs={tmp_path / 'logs'}",
        f"evaluate.checkpoint={head}",
    )
    output = tmp_path / "report"
    assert run("", train_head.main, arguments(trained, output, *own)) == 0
    found = []
    for samples in (1, 8):
        told = arguments(trained, output, *own, f"evaluate.samples={samples}")
        assert run("", evaluate.main, told) == 0
        document = json.loads((output / "judged.json").read_text())
        assert document["policy"]["samples"] == samples
        assert document["drawn"] == {"samples": samples, "batch_size": 64}
        found.append(json.loads((output / "metrics.json").read_text()))
    one, many = found
    assert "samples" not in one
    error = many["chunk"]["overall"]["policy"]["value"]
    assert error == many["samples"]["one"]["value"] != one["chunk"]["overall"]["policy"]["value"]
    assert many["samples"]["mean_of_n"]["value"] < error
    assert many["samples"]["best_of_n"]["value"] < error


def test_the_rollouts_of_this_policy_are_linked_though_they_come_later(trained, tmp_path, reports):
    for checkpoint in ("null", "models/another"):
        rollout = {
            "environment": "phantom",
            "checkpoint": checkpoint,
            "output": tmp_path / "rollout",
        }
        overrides = [f"rollout.{key}={value}" for key, value in rollout.items()]
        assert run("", evaluate.main, arguments(trained, tmp_path / "report", *overrides)) == 0
    pages = [{text.page for text in report.blocks(Text)} - {""} for report in reports]
    assert pages == [{"../rollout/report.html"}, set()]
