"""The command refuses a checkpoint and a store that do not belong together."""

import json
import shutil
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import pytest
import yaml

from pipeline.look.page import writing
from pipeline.look.page.blocks import Report, Text
from stages import evaluate
from stages.command import run

ROOT = Path(__file__).resolve().parents[2]
PICTURES = ("episode_worst", "horizon", "methods")


@pytest.fixture(scope="module")
def judged(trained_tiny: Path) -> tuple[Path, str]:
    """Where its evaluation lies, whole, and what was said; not to be written to."""
    said = StringIO()
    with redirect_stdout(said):
        assert run("", evaluate.main, ["--params", str(trained_tiny)]) == 0
    return trained_tiny.parent / "report", said.getvalue()


@pytest.fixture
def reports(monkeypatch: pytest.MonkeyPatch) -> list[Report]:
    """The pages that evaluations here would write: most of their time goes into pictures."""
    found: list[Report] = []

    def kept(folder: Path, report: Report) -> list[Path]:
        found.append(report)
        return []

    monkeypatch.setattr(writing, "write_report", kept)
    return found


def arguments(trained_tiny: Path, output: Path, *overrides: str) -> list[str]:
    """Of an evaluation into `output` that leaves the streams alone."""
    told = (f"evaluate.output={output}", "evaluate.modalities=false", *overrides)
    return ["--params", str(trained_tiny), *(part for one in told for part in ("--set", one))]


@pytest.mark.usefixtures("reports")
def test_a_store_that_grew_is_judged_on_the_same_episodes(
    trained_tiny, judged, tiny_store, tmp_path
):
    report, said = judged
    assert "30 test ticks of 1 episode(s)" in said
    grown = f"evaluate.store={tiny_store(tmp_path, episodes=9)}"
    assert run("", evaluate.main, arguments(trained_tiny, tmp_path / "report", grown)) == 0
    assert (tmp_path / "report/judged.json").read_bytes() == (report / "judged.json").read_bytes()


@pytest.mark.usefixtures("reports")
def test_a_flipped_bit_is_refused_where_it_would_be_judged_on(
    trained_tiny, tiny_store, flip, tmp_path, capsys
):
    store = tiny_store(tmp_path, name="flipped")
    file = flip(store, "vl/features")
    told = arguments(trained_tiny, tmp_path / "report", f"evaluate.store={store}")
    assert run("", evaluate.main, told) == 2
    assert f"{file}: " in capsys.readouterr().err
    assert not (tmp_path / "report").exists()
    assert run("", evaluate.main, [*told, "--set", "evaluate.check_store=false"]) == 0


def test_what_cannot_be_evaluated_says_what_to_do(trained_tiny, tmp_path, capsys):
    for override, message in (
        (f"evaluate.checkpoint={tmp_path / 'nowhere'}", "Run stages.train_head"),
        ("evaluate.execute=9", "evaluate.execute 9: expected at most the 8 steps"),
    ):
        assert run("", evaluate.main, arguments(trained_tiny, tmp_path / "report", override)) == 2
        assert message in capsys.readouterr().err


@pytest.mark.usefixtures("reports")
def test_without_a_checkpoint_it_judges_what_train_head_wrote(
    trained_tiny, tmp_path, monkeypatch, capsys
):
    """Not an older head that lies where heads lie by default."""
    shutil.copytree(trained_tiny.parent / "head", tmp_path / "models/head")
    monkeypatch.chdir(tmp_path)
    document = yaml.safe_load(trained_tiny.read_text())
    del document["evaluate"]["checkpoint"]
    params = tmp_path / "params.yaml"
    params.write_text(yaml.safe_dump(document))
    assert run("", evaluate.main, arguments(params, tmp_path / "report")) == 0
    assert f"{trained_tiny.parent / 'head'} (step 3)" in capsys.readouterr().out


def test_the_report_says_what_was_judged_and_which_streams_are_used(judged):
    """One test episode: nothing can be drawn anew, and the report says so."""
    report, said = judged
    assert "sensor    zeroed" in said
    assert "intervals take at least two" in said
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


def test_the_rollouts_of_this_policy_are_linked_though_they_come_later(
    trained_tiny, tmp_path, reports
):
    for checkpoint in ("null", "models/another"):
        rollout = {
            "environment": "phantom",
            "checkpoint": checkpoint,
            "output": tmp_path / "rollout",
        }
        overrides = [f"rollout.{key}={value}" for key, value in rollout.items()]
        assert run("", evaluate.main, arguments(trained_tiny, tmp_path / "report", *overrides)) == 0
    pages = [{text.page for text in report.blocks(Text)} - {""} for report in reports]
    assert pages == [{"../rollout/report.html"}, set()]
