"""The command exports what was trained, and refuses what it cannot."""

import json
import sys
from pathlib import Path

from stages import export
from stages.command import run


def exported(trained_tiny: Path, *overrides: str) -> int:
    told = [part for one in overrides for part in ("--set", one)]
    return run("", export.main, ["--params", str(trained_tiny), *told])


def test_the_trained_head_is_exported_with_its_receipt(trained_tiny, capsys):
    assert exported(trained_tiny, "export.formats=[torch]") == 0
    assert "head.pt2, receipt.json" in capsys.readouterr().out
    receipt = json.loads((trained_tiny.parent / "export/receipt.json").read_text())
    assert receipt["checkpoint"] == str(trained_tiny.parent / "head")
    assert receipt["feature_spec_digest"] == "tiny-spec"
    assert receipt["files"]["head.pt2"]["deviation"]["random"]["std"] < 1e-5


def test_what_is_missing_is_said_in_one_message(trained_tiny, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert exported(trained_tiny, f"export.output={tmp_path / 'new'}") == 2
    assert "pip install 'vla-feature-cache[export]'" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
    assert exported(trained_tiny, f"export.checkpoint={tmp_path / 'none'}") == 2
    assert "expected a checkpoint" in capsys.readouterr().err
