"""The command prints a ranking and what to write into params.yaml, and keeps both as files."""

import csv
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
import zarr

from pipeline.base.files import MARKER
from pipeline.store import FeatureStore
from pipeline.store.chunks import write_seal
from pipeline.store.proofs import find_proof
from stages import probe
from stages.command import run

FILES = ["groups.csv", "metrics.json", "probe.png", "report.html", "slots.csv"]


@pytest.fixture
def params(tiny_store: Callable[..., Path], tmp_path: Path) -> Path:
    """A params.yaml beside a store of one mean and of four cells of one view."""
    path = tiny_store(tmp_path, slots=5, episodes=12)
    cells = [[row, column] for row in range(2) for column in range(2)]
    place = {"layer": 3, "norm": True, "pooling": "grid", "view": "View1"}
    slots = [{"layer": 3, "norm": True, "pooling": "mean"}, *(place | {"cell": c} for c in cells)]
    zarr.open_group(path, mode="r+").attrs["slots"] = slots
    write_seal(path)
    document = {
        "data": {"sources": [{"name": "left", "path": "a"}]},
        "vlm": {"checkpoint": "unused"},
        "extract": {"store": str(path)},
        "probe": {
            # Its attributes were written over, as no store is that was extracted so.
            "check_store": False,
            "output": str(tmp_path / "report"),
            "horizon": 2,
            "sensor_window": 4,
            "state_window": 4,
        },
    }
    file = tmp_path / "params.yaml"
    file.write_text(yaml.safe_dump(document))
    return file


def test_a_ranking_files_and_pictures(params: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("", probe.main, ["--params", str(params)]) == 0
    lines = capsys.readouterr().out.splitlines()
    report = params.parent / "report"
    assert sorted(file.name for file in report.iterdir()) == [MARKER, *FILES]
    # The action's first two channels are those of slot 0, which is the mean.
    assert [line.split("  ")[0] for line in lines[2:7]] == [
        "mean action",
        "past actions",
        "past actions + state",
        "past actions + state + sensor",
        "layer 3, mean",
    ]
    page = (report / "report.html").read_text()
    assert "Keep layer 3, mean" in page and "What to do next" in page
    assert lines[-2].endswith("vlm: {layers: [3], norms: [true], pooling: [mean]}")
    assert sum("View1 cell" in line for line in lines) == 4

    slots = list(csv.DictReader((report / "slots.csv").read_text().splitlines()))
    assert [one["pooling"] for one in slots] == ["mean"] + ["grid"] * 4
    assert {one["cell"] for one in slots[1:]} == {"0,0", "0,1", "1,0", "1,1"}
    groups = list(csv.DictReader((report / "groups.csv").read_text().splitlines()))
    assert [(one["pooling"], one["slots"]) for one in groups] == [("mean", "1"), ("grid", "4")]
    found = json.loads((report / "metrics.json").read_text())
    assert found["recommended"]["group"] == "layer 3, mean"
    beside = found["groups"]["layer 3, mean"]["beside"]
    assert list(beside) == ["r2", "low", "high"]
    assert beside["r2"] == float(groups[0]["r2_beside"])
    assert float(groups[0]["gain_low"]) < float(groups[0]["gain"]) < float(groups[0]["gain_high"])
    assert found["known"]["past actions + state + sensor"]["r2"] == float(groups[0]["r2_known"])
    assert found["repeats"] == 3


def test_the_same_again_gives_the_same_bytes_and_leaves_the_store(params: Path) -> None:
    report, store = params.parent / "report", params.parent / "tiny.zarr"
    stored = {file: file.read_bytes() for file in store.rglob("*") if file.is_file()}
    assert run("", probe.main, ["--params", str(params)]) == 0
    before = {name: (report / name).read_bytes() for name in FILES}
    again = ["--params", str(params), "--set", "probe.threads=1"]
    assert run("", probe.main, again) == 0
    assert {name: (report / name).read_bytes() for name in FILES} == before
    assert {file: file.read_bytes() for file in store.rglob("*") if file.is_file()} == stored
    FeatureStore.open(store)


def test_what_cannot_be_probed_is_said(params, tiny_store, tmp_path, capsys):
    lonely = tiny_store(tmp_path, name="lonely", episodes=1)
    arguments = ["--params", str(params), "--set", f"probe.store={lonely}"]
    assert run("", probe.main, arguments) == 2
    assert "two recordings" in capsys.readouterr().err
    assert run("", probe.main, ["--params", str(params), "--set", "probe.horizon=31"]) == 2
    assert "shorter probe.horizon" in capsys.readouterr().err
    assert not (params.parent / "report").exists()


def test_a_damaged_store_is_refused(params, tiny_store, flip, tmp_path, capsys):
    store = tiny_store(tmp_path, name="sound", episodes=6)
    arguments = ["--params", str(params), "--set", f"probe.store={store}"]
    checked = [*arguments, "--set", "probe.check_store=true"]
    assert run("", probe.main, checked) == 0
    assert "3 slots of 8 channels at 180 ticks" in capsys.readouterr().out
    (params.parent / "report" / "metrics.json").unlink()
    flip(store, "vl/features")
    assert run("", probe.main, checked) == 2
    error = capsys.readouterr().err
    assert "vl/features" in error
    assert "stages.verify" in error
    assert not (params.parent / "report" / "metrics.json").exists()
    assert run("", probe.main, arguments) == 0


def test_what_a_type_would_lose_is_kept_beside_the_store(
    params: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--params", str(params), "--set", "probe.codecs=[int8, {pca: 4}]"]
    assert run("", probe.main, arguments) == 0
    file = params.parent / "tiny.zarr.proofs.json"
    assert f"{file}: what these types lose" in capsys.readouterr().out
    store = FeatureStore.open(params.parent / "tiny.zarr")
    spec = store.spec | {"slots": store.attrs["slots"]}
    proof = find_proof(params.parent, spec | {"storage_dtype": "int8"})
    assert proof is not None
    assert proof.recordings == 12
    assert [loss.of for loss in proof.losses] == ["layer 3, mean", "layer 3, grid"]
    few = spec | {"storage_dtype": "int8", "dim": 4, "pca": {"of": 8, "basis": "any"}}
    assert find_proof(params.parent, few | {"slots": spec["slots"][:1]}) is not None


def test_without_the_model_passes_are_not_timed(
    params: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("", probe.main, ["--params", str(params), "--set", "probe.time=true"]) == 0
    assert "not timed: " in (said := capsys.readouterr().out)
    assert "s a pass" not in said
