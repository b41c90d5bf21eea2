"""The command runs a checkpoint in the phantom, or says why it cannot."""

import json
from pathlib import Path
from typing import Any

import pytest

from stages import rollout
from stages.command import run

Said = pytest.CaptureFixture[str]


def arguments(trained: Path, **changed: Any) -> list[str]:
    told = [f"rollout.{name}={value}" for name, value in changed.items()]
    return ["--params", str(trained), *(part for line in told for part in ("--set", line))]


def test_it_writes_metrics_table_and_page_the_same_every_time(
    trained, tmp_path, capsys, monkeypatch
):
    for output in ("first", "second"):
        told = arguments(trained, output=tmp_path / output, episodes=1, ablations='["sensor off"]')
        assert run("", rollout.main, told) == 0
        said = capsys.readouterr().out
        assert "demonstrator" in said and "100%" in said
        assert "policy, sensor off: " in said
        monkeypatch.setattr("pipeline.look.page.writing.write_report", lambda *_: [])
    assert (tmp_path / "first" / "report.html").exists()
    for name in ("metrics.json", "settings.json", "episodes.csv", "beside.csv"):
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()
    success = json.loads((tmp_path / "first" / "metrics.json").read_text())["success"]
    assert success["expert"] | {"rate": 1.0, "episodes": 1} == success["expert"]
    assert set(success) == {"policy", "sensor off", "expert"}
    assert len((tmp_path / "first" / "episodes.csv").read_text().splitlines()) == 2


def test_what_cannot_be_run_is_refused_by_name(trained: Path, capsys: Said) -> None:
    cases: list[tuple[dict[str, Any], str]] = [
        ({"checkpoint": "nowhere"}, "expected a checkpoint"),
        ({"execute": 99}, "rollout.execute"),
        ({"chunking": "rtc"}, "rollout.chunking"),
    ]
    for changed, message in cases:
        assert run("", rollout.main, arguments(trained, **changed)) == 2
        assert message in capsys.readouterr().err
    assert not (trained.parent / "rollout").exists()


def test_a_folder_of_somebody_else_is_left_alone(trained, tmp_path, capsys):
    (tmp_path / "thesis.txt").write_text("all of it")
    assert run("", rollout.main, arguments(trained, output=tmp_path)) == 2
    assert "thesis.txt" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
