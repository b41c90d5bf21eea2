"""The stage hands the params on and ends as every stage ends."""

from pathlib import Path

import yaml

from pipeline.simulation import demo_recordings
from pipeline.vlm import demo_checkpoint
from stages import command, demo


def write_weights(folder: Path, seed: int) -> None:
    (folder / "weights").write_text(str(seed), encoding="utf-8")


def test_writes_recordings_and_checkpoint(tmp_path, monkeypatch, capsys):
    """Both in no time."""
    calls: list[tuple[object, ...]] = []
    monkeypatch.setattr(
        demo_recordings, "write_demo_recordings", lambda *given: calls.append(given)
    )
    monkeypatch.setattr(demo_checkpoint, "write_checkpoint_files", write_weights)
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
    params = tmp_path / "params.yaml"
    params.write_text(yaml.safe_dump(document), encoding="utf-8")
    # The second time replaces the demo's own.
    for _ in range(2):
        assert command.run("", demo.main, ["--params", str(params)]) == 0
    assert calls == [(tmp_path / "recordings", 2, 5)] * 2
    assert (tmp_path / "vlm" / "weights").read_text(encoding="utf-8") == "5"
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["vlm"]
    assert "2 episodes" in capsys.readouterr().out
