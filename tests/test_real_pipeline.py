"""Real recordings through the whole pipeline, by the stages that a user would run."""

import importlib
import io
import json
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from pipeline.base.config import load_params
from pipeline.store import FeatureStore

ROOT = Path(__file__).resolve().parents[1]
REUSE = 20
Run = Callable[..., str]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("real")


@pytest.fixture(scope="module")
def run(folder: Path, demo_checkpoint: Path) -> Run:
    """`run("extract", name, data)`: the stage with params of its own, its output returned."""

    def stage(stage: str, name: str, data: dict[str, Any]) -> str:
        document = yaml.safe_load((ROOT / "params.yaml").read_text())
        document["data"] |= data
        document["vlm"] |= {
            "checkpoint": str(demo_checkpoint),
            "image_resize_height": 56,
            "image_resize_width": 56,
        }
        document["extract"]["store"] = str(folder / f"{name}.zarr")
        document["train_head"] |= {
            "max_steps": 10,
            "eval_every": 5,
            "output": str(folder / name / "head"),
            "logs": str(folder / name / "logs"),
        }
        document["evaluate"] = {
            "checkpoint": str(folder / name / "head"),
            "output": str(folder / name / "evaluate"),
        }
        params = folder / f"{name}.yaml"
        params.write_text(yaml.safe_dump(document))
        with redirect_stdout(io.StringIO()) as said:
            importlib.import_module(f"stages.{stage}").main(load_params(params))
        return said.getvalue()

    return stage


@pytest.fixture(scope="module")
def cr5_data(shared_data: Path) -> dict[str, Any]:
    """Five episodes of LeRobot v3.0, in two files."""
    return {
        "root": str(shared_data / "lerobot"),
        "sources": [{"name": "cr5", "path": "cr5_banana_v30_split"}],
        "vlm_reuse_count": REUSE,
    }


@pytest.fixture(scope="module")
def cr5(run: Run, cr5_data: dict[str, Any], folder: Path) -> FeatureStore:
    """Their store."""
    run("extract", "cr5", cr5_data)
    return FeatureStore.open(folder / "cr5.zarr")


def test_the_ticks_are_the_recorded_rows(cr5):
    counts = [176, 193, 204, 181, 181]
    assert cr5.ticks == 935
    assert [len(episode.ticks) for episode in cr5.episodes] == counts
    assert len(cr5.array("vl/time")) == sum(-(-count // REUSE) for count in counts)
    assert cr5.streams["action"]["kind"] == "velocity"
    assert {episode.instruction for episode in cr5.episodes} == {"put the banana on the plate"}
    assert np.diff(cr5.array("tick/time")[:176]).std() > 1e-3, "a real clock jitters"


@pytest.mark.usefixtures("cr5")
def test_a_head_is_trained_and_judged(cr5_data, run, folder):
    said = run("train_head", "cr5", cr5_data)
    assert "sensor: absent from the store" in said
    run("evaluate", "cr5", cr5_data)
    metrics = json.loads((folder / "cr5/evaluate/metrics.json").read_text())
    assert metrics["test"]["episodes"] >= 1
    for figures in (metrics["executed"]["overall"], metrics["chunk"]["overall"]):
        assert np.isfinite([figures["policy"]["value"], figures["difference"]["value"]]).all()


def test_three_insertion_formats_share_a_store(run, shared_data, folder):
    data = {
        "root": str(shared_data / "insertion"),
        "sources": [{"name": name, "path": name} for name in ("raw", "new", "old")],
    }
    run("extract", "insertion", data)
    store = FeatureStore.open(folder / "insertion.zarr")
    raw, new, old = store.episodes
    assert (raw.format, new.format, old.format) == ("raw", "new", "old")
    assert store.streams["views"] == ["View1", "View2", "View3", "View5"]
    assert store.sensor_channels == 1026
    assert (len(raw.readings), len(new.readings), len(old.readings)) == (1950, 1950, 32)
    assert not len(old.states), "the old recording has no robot state"
    keys = store.array("vl/key")
    assert np.array_equal(keys[raw.vl_rows[0]], keys[new.vl_rows[0]]), "the same frames"
    frames = store.array("vl/frame_time")[slice(old.vl_rows.start, old.vl_rows.stop)]
    assert np.isnan(frames[:, 2:]).all(), "two of its views never came up"
    a, b = (store.array("tick/action")[one.ticks.start + 5] for one in (raw, new))
    assert np.allclose(a, b, atol=0.01), "derived from the same motion"
    said = run("train_head", "insertion", data)
    assert " test of " in said
    run("evaluate", "insertion", data)
    assert (folder / "insertion/evaluate/horizon.png").stat().st_size > 10_000
