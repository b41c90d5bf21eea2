"""The stage hands the params on and ends as every stage ends."""

from pathlib import Path

import pytest
import yaml

from pipeline.simulation import demo_recordings
from pipeline.vlm import demo_checkpoint
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


def write_weights(folder: Path, seed: int) -> None:
    (folder / "weights").write_text(str(seed), encoding="utf-8")


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[object, ...]]:
    """What recordings were asked for; they and the checkpoint are written in no time."""
    made: list[tuple[object, ...]] = []
    monkeypatch.setattr(demo_recordings, "write_demo_recordings", lambda *given: made.append(given))
    monkeypatch.setattr(demo_checkpoint, "write_checkpoint_files", write_weights)
    return made


def ran(params: Path) -> int:
    return command.run("", demo.main, ["--params", str(params)])


def test_writes_recordings_and_checkpoint(params, calls, tmp_path, capsys):
    # The second time replaces the demo's own.
    for _ in range(2):
        assert ran(params) == 0
    assert calls == [(tmp_path / "recordings", 2, 5)] * 2
    assert (tmp_path / "vlm" / "weights").read_text(encoding="utf-8") == "5"
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["vlm"]
    assert "2 episodes" in capsys.readouterr().out


@pytest.mark.usefixtures("calls")
def test_stopped_while_it_writes_the_same_command_goes_on(params, tmp_path, monkeypatch, capsys):
    def stopped(folder: Path, seed: int) -> None:
        write_weights(folder, seed)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(demo_checkpoint, "write_checkpoint_files", stopped)
        assert ran(params) == 1
    assert capsys.readouterr().err == "stopped; run the same command again\n"
    assert not (tmp_path / "vlm").exists()
    assert ran(params) == 0
    assert (tmp_path / "vlm/weights").exists()


@pytest.mark.usefixtures("calls")
def test_what_a_user_put_among_the_demos_files_is_left_alone(params, tmp_path, capsys):
    assert ran(params) == 0
    (tmp_path / "vlm/model.safetensors").write_text("mine", encoding="utf-8")
    assert ran(params) == 2
    assert f"{tmp_path / 'vlm'}: expected the files that the demo wrote" in capsys.readouterr().err
    assert (tmp_path / "vlm/model.safetensors").read_text(encoding="utf-8") == "mine"
