"""The stage hands the params on and ends as every stage ends."""

from pathlib import Path

import pytest
import yaml

from stages import command, demo


@pytest.fixture
def params(tmp_path: Path) -> Path:
    path = tmp_path / "params.yaml"
    document = {
        "demo": {
            "recordings": str(tmp_path / "recordings"),
            "checkpoint": str(tmp_path / "vlm"),
            "episodes": 2,
            "seed": 5,
        },
        "data": {"sources": [{"name": "raw", "path": "raw"}]},
        "vlm": {"checkpoint": str(tmp_path / "vlm")},
    }
    path.write_text(yaml.safe_dump(document), encoding="utf-8")
    return path


def test_writes_recordings_and_checkpoint(
    params: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    calls: list[tuple[object, ...]] = []
    monkeypatch.setattr(demo, "write_demo_recordings", lambda *given: calls.append(given))
    monkeypatch.setattr(demo, "write_demo_checkpoint", lambda *given: calls.append(given))
    assert command.run("", demo.main, ["--params", str(params)]) == 0
    assert calls == [(tmp_path / "recordings", 2, 5), (tmp_path / "vlm", 5)]
    assert "2 episodes" in capsys.readouterr().out


def test_foreign_recordings_end_with_2_and_no_checkpoint(
    params: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "recordings" / "precious").mkdir(parents=True)
    assert command.run("", demo.main, ["--params", str(params)]) == 2
    assert "demo.recordings" in capsys.readouterr().err
    assert not (tmp_path / "vlm").exists()
