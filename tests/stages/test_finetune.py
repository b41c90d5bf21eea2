"""`stages.finetune` as a user meets it: what it prints, how it stops, what it refuses."""

import json
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from stages import evaluate, extract, finetune, train_head
from stages.command import run
from tests.train.finetuning.conftest import write_episode

Said = pytest.CaptureFixture[str]
Make = Callable[..., Any]


@pytest.fixture(scope="session")
def extracted(tmp_path_factory: pytest.TempPathFactory, demo_checkpoint: Path) -> Path:
    """A params.yaml whose store of three recordings is finished."""
    root = tmp_path_factory.mktemp("finetune_stage")
    for seed in range(3):
        write_episode(root / "recordings" / "Touch_dot" / f"episode_{seed}", seed, ("View1",))
    document = {
        "data": {"root": str(root / "recordings"), "sources": [{"name": "made", "path": "."}]},
        "vlm": {
            "checkpoint": str(demo_checkpoint),
            "dtype": "float32",
            "image_resize_height": 28,
            "image_resize_width": 56,
        },
        "extract": {"store": str(root / "made.zarr"), "device": "cpu"},
        "train_head": {
            "robot_state_enabled": False,
            "expert": {"dim": 8, "layers": 1, "heads": 1},
            "split": {"val": 0.3, "test": 0.3},
            "max_steps": 3,
            "device": "cpu",
            "output": str(root / "head"),
            "logs": str(root / "head_logs"),
        },
        "finetune": {"batch_size": 4, "max_steps": 4, "eval_every": 2, "checkpoint_every": 2},
        "evaluate": {"device": "cpu", "modalities": False},
    }
    path = root / "params.yaml"
    path.write_text(yaml.safe_dump(document))
    assert run("", extract.main, ["--params", str(path)]) == 0
    return path


@pytest.fixture
def write_params(extracted: Path, tmp_path: Path) -> Make:
    """`write_params(name, finetune={...}, ...)`: params that work below the test's folder."""

    def write(name: str = "tuned", **sections: dict[str, Any]) -> Path:
        document = yaml.safe_load(extracted.read_text())
        document["finetune"] |= {
            "output": str(tmp_path / name),
            "logs": str(tmp_path / f"{name}_logs"),
        }
        for section, values in sections.items():
            document[section] |= values
        path = tmp_path / f"{name}.yaml"
        path.write_text(yaml.safe_dump(document))
        return path

    return write


def test_a_flipped_bit_is_refused_before_tuning(write_params, extracted, flip, tmp_path, capsys):
    store = extracted.parent / "made.zarr"
    file = flip(store, "tick/action")
    try:
        assert run("", finetune.main, ["--params", str(write_params())]) == 2
    finally:
        flip(store, "tick/action")
    assert f"{file}: " in capsys.readouterr().err
    assert not (tmp_path / "tuned.part").exists()


def test_it_tunes_and_says_how_to_go_on_and_that_works(
    write_params, extracted, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("pipeline.look.page.writing.write_report", lambda *_: [])
    params, seed = str(write_params(extract={"dtype": "int8"})), "train_head.seed=1"
    assert run("", finetune.main, ["--params", params, "--set", seed]) == 0
    captured = capsys.readouterr()
    assert captured.err == "", "no progress where there is no terminal"
    assert "vlm, learning" in captured.out
    assert "vlm, frozen" in captured.out
    assert "tuning: lora of rank 16 on the language and vision tower" in captured.out
    assert "step 4: train loss" in captured.out
    adapter, tuned = tmp_path / "tuned" / "best" / "adapter", extracted.parent / "made_tuned.zarr"
    training = f"--set train_head.store={tuned}"
    apart = "--set train_head.output=models/made_tuned --set train_head.logs=reports/made_tuned"
    same = f"--params {params} --set {seed}"
    assert f"python -m stages.train_head {training} {apart}_training {same}\n" in captured.out
    assert f"python -m stages.evaluate --set evaluate.store={tuned} " in captured.out

    assert run("", finetune.main, ["--params", params, "--set", seed]) == 0
    assert "nothing to do" in capsys.readouterr().out

    _, _, printed = captured.out.partition("python -m stages.extract ")
    assert run("", extract.main, shlex.split(printed.splitlines()[0])) == 0, "as it was printed"
    spec = json.loads((tuned / "zarr.json").read_text())["attributes"]["feature_spec"]
    assert spec["adapter"] is not None and adapter.is_dir()
    assert spec["storage_dtype"] == "float32", "the type of the store that it was tuned on"
    assert run("", train_head.main, ["--params", params, *training.split()]) == 0
    report = tmp_path / "report"
    judged = [f"evaluate.checkpoint={tmp_path / 'tuned'}", f"evaluate.output={report}"]
    options = [part for one in judged for part in ("--set", one)]
    assert run("", evaluate.main, ["--params", params, *training.split(), *options]) == 0
    found = json.loads((report / "metrics.json").read_text())
    best = json.loads((tmp_path / "tuned" / "best" / "policy.json").read_text())
    assert found["chunk"]["overall"]["policy"]["value"] > 0
    assert [len(best["split"][side]) for side in ("train", "val", "test")] == [1, 1, 1]

    other = ["--set", "train_head.split.seed=2", "--set", f"train_head.output={tmp_path / 'other'}"]
    capsys.readouterr()
    assert run("", train_head.main, ["--params", params, *training.split(), *other]) == 2
    said = capsys.readouterr().err
    (chosen,), (learned,) = best["split"]["val"], best["split"]["train"]
    assert f"test: {learned}" in said or f"test: {chosen}" in said or f"val: {learned}" in said
    assert "what stages.finetune had, the same seed" in said

    capsys.readouterr()
    assert run("", evaluate.main, ["--params", params, *options]) == 2
    assert "feature_spec.adapter" in capsys.readouterr().err, "these features are not the tuned"


def test_mistakes_end_in_one_message(write_params: Make, tmp_path: Path, capsys: Said) -> None:
    params = write_params()
    for override, said in (
        ("finetune.tuning.method=none", "python -m stages.train_head"),
        ("train_head.features_enabled=false", "would not see the model"),
        ("vlm.prompt=look", 'prompt: "{instruction}'),
        ("data.sources=[{name: other, path: .}]", "no source has it"),
        ("vlm.dtype=float16", 'compute_dtype: "float32" -> "float16"'),
    ):
        assert run("", finetune.main, ["--params", str(params), "--set", override]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "tuned.part").exists(), "bad params leave nothing behind"
