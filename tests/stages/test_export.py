"""The command exports what was trained, and refuses what it cannot."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from stages import export, train_head
from stages.command import run


@pytest.fixture(scope="module")
def trained(
    quick_params: Callable[[Path], dict[str, Any]], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A params.yaml whose head is trained."""
    folder = tmp_path_factory.mktemp("export")
    document = quick_params(folder) | {"export": {"output": str(folder / "export")}}
    path = folder / "params.yaml"
    path.write_text(yaml.safe_dump(document))
    assert run("", train_head.main, ["--params", str(path)]) == 0
    return path


def exported(trained: Path, *overrides: str) -> int:
    told = [part for one in overrides for part in ("--set", one)]
    return run("", export.main, ["--params", str(trained), *told])


def test_the_trained_head_is_exported_with_its_receipt(trained, capsys):
    assert exported(trained, "export.formats=[torch]") == 0
    assert "head.pt2, receipt.json" in capsys.readouterr().out
    receipt = json.loads((trained.parent / "export/receipt.json").read_text())
    assert receipt["checkpoint"] == str(trained.parent / "head")
    assert receipt["feature_spec_digest"] == "tiny-spec"
    assert receipt["files"]["head.pt2"]["deviation"]["random"]["std"] < 1e-5


def test_what_is_missing_is_said_in_one_message(trained, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert exported(trained, f"export.output={tmp_path / 'new'}") == 2
    assert "pip install 'vla-feature-cache[export]'" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
    assert exported(trained, f"export.checkpoint={tmp_path / 'none'}") == 2
    assert "expected a checkpoint" in capsys.readouterr().err
