"""`stages.extract` as a user meets it: exit codes and messages."""

import json
from pathlib import Path

import pytest
import yaml

from pipeline.simulation.lerobot_format import write_lerobot
from pipeline.simulation.recorder import simulate_episode
from stages.command import run
from stages.extract import main

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def params_file(tmp_path: Path, demo_checkpoint: Path) -> Path:
    document = yaml.safe_load((ROOT / "params.yaml").read_text())
    document["data"] |= {"root": str(tmp_path), "sources": [{"name": "lab", "path": "day*/run"}]}
    document["vlm"]["checkpoint"] = str(demo_checkpoint)
    document["extract"]["store"] = str(tmp_path / "lab.zarr")
    path = tmp_path / "params.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def said(capsys: pytest.CaptureFixture[str], params_file: Path, *overrides: str) -> str:
    """What stands on stderr after exit 2."""
    options = [part for override in overrides for part in ("--set", override)]
    assert run("", main, ["--params", str(params_file), *options]) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert "Traceback" not in err
    return err


def test_an_empty_glob(capsys, params_file, tmp_path):
    err = said(capsys, params_file)
    assert "'day*/run' matches nothing" in err
    assert str(tmp_path) in err


def test_a_folder_without_episodes(capsys, params_file, tmp_path):
    (tmp_path / "day1" / "run").mkdir(parents=True)
    err = said(capsys, params_file)
    assert "none with an episode" in err
    assert "metadata.json" in err


def test_an_unknown_codebase_version(capsys, params_file, tmp_path):
    meta = tmp_path / "day1/run/meta"
    meta.mkdir(parents=True)
    (meta / "info.json").write_text('{"codebase_version": "v9.0", "fps": 10, "features": {}}')
    assert "v9.0" in said(capsys, params_file)


def test_a_depth_map_that_is_asked_for_as_a_view(capsys, params_file, tmp_path):
    write_lerobot(tmp_path / "day1/run", iter([simulate_episode(4, 0.0)]))
    info = tmp_path / "day1/run/meta/info.json"
    document = json.loads(info.read_text())
    document["features"]["observation.images.View2"]["info"]["video.is_depth_map"] = True
    info.write_text(json.dumps(document))
    assert "data.views asks for View2" in said(capsys, params_file, "data.views=[View1, View2]")
    options = ["--params", str(params_file), "--set", "extract.plan=true"]
    assert run("", main, options) == 0
    assert "source 'lab': view View2 is a depth map" in capsys.readouterr().out


def test_a_checkpoint_that_is_not_there(capsys, params_file, tmp_path, request):
    write = request.getfixturevalue("shared_data")
    err = said(
        capsys,
        params_file,
        f"data.root={write / 'lerobot'}",
        "data.sources=[{name: cr5, path: cr5_banana_v21}]",
        f"vlm.checkpoint={tmp_path / 'nowhere'}",
    )
    assert str(tmp_path / "nowhere") in err
