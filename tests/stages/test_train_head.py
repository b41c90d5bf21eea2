"""The command: what it prints, how it stops, what it needs."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from pipeline.store import build_lock
from stages import train_head
from stages.command import run

Make = Callable[..., Any]

BOTH = """
import sys
from stages import evaluate, train_head
from stages.command import run
from pipeline.look.page import writing

writing.write_report = lambda *_: []  # most of the time goes into pictures
arguments = ["--params", sys.argv[1]]
sys.exit(run("", train_head.main, arguments) or run("", evaluate.main, arguments))
"""
NOTHING_TO_DO = """
import sys
from stages import train_head
from stages.command import run

assert run("", train_head.main, sys.argv[1:]) == 0
heavy = "torch transformers dask distributed scipy matplotlib sklearn pandas"
print(sorted(set(heavy.split()) & sys.modules.keys()))
"""
"""A finished training, which says what it imported of what takes long."""


LONGER = {
    "horizon": 3,
    "max_steps": 30,
    "warmup_steps": 3,
    "eval_every": 10,
    "checkpoint_every": 4,
}


@pytest.fixture
def write_params(
    tiny_store: Make, tiny_head: Callable[..., dict[str, Any]], tmp_path: Path
) -> Make:
    """`write_params(train_head={...}, store={...})`: a params.yaml on a small store."""

    def write(store: dict[str, Any] | None = None, **head: Any) -> Path:
        place = tiny_store(tmp_path, name="params", **(store or {}))
        document = {
            "data": {"sources": [{"name": "left", "path": "a"}, {"name": "right", "path": "b"}]},
            "vlm": {"checkpoint": "unused"},
            "extract": {"store": str(place)},
            "train_head": tiny_head(tmp_path / "params", **LONGER | head),
            "evaluate": {
                "checkpoint": str(tmp_path / "params" / "head"),
                "output": str(tmp_path / "params" / "report"),
                "device": "cpu",
            },
        }
        path = tmp_path / "params.yaml"
        path.write_text(yaml.safe_dump(document))
        return path

    return write


def test_it_trains_evaluates_and_then_has_nothing_to_do(started, write_params, tmp_path):
    """With neither transformers nor peft, and silent where there is no terminal."""
    params = write_params(
        store={"sensor_channels": 0, "episodes": 4, "ticks": 12}, robot_state_enabled=False
    )
    process = started(BOTH, params, without=("transformers", "peft"))
    said, err = process.communicate()
    assert (process.returncode, err) == (0, "")
    assert "4 episodes, 48 ticks" in said
    assert "sensor: absent from the store, its encoder is disabled" in said
    assert "state: disabled by train_head.robot_state_enabled" in said
    assert "split: 24 training ticks, 12 val, 12 test of 2 + 1 + 1 groups" in said
    assert "parameters: " in said and "(features " in said
    assert "trained 30 steps in " in said
    assert "device cpu, float32; steps 0 to 30" in said
    assert "step 30: train loss" in said
    assert "overall [training std]" in said
    assert "12 test ticks of 1 episode(s)" in said

    command = [sys.executable, "-c", NOTHING_TO_DO, "--params", str(params)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "nothing to do" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]"

    report = tmp_path / "params/report"
    found = json.loads((report / "metrics.json").read_text())
    best = json.loads((tmp_path / "params/head/best/policy.json").read_text())
    error = found["chunk"]["overall"]["policy"]["value"]
    assert error != best["metrics"]["val/error"], "val chose, test reports"


def test_two_runs_do_not_write_their_curves_into_one_folder(write_params, tmp_path, capsys):
    params, logs = write_params(max_steps=2, store={"episodes": 3, "ticks": 12}), tmp_path / "logs"
    arguments = ["--params", str(params), "--set", f"train_head.logs={logs}"]
    with build_lock(logs):  # as another run holds it, to another output
        assert run("", train_head.main, arguments) == 2
    said = capsys.readouterr().err
    assert f"{logs}: being built by process {os.getpid()} on" in said
    assert f"name another place than {logs}" in said
    assert run("", train_head.main, arguments) == 0, "the same run goes on"


def test_a_flipped_bit_is_refused_where_it_would_be_learnt_from(
    write_params, flip, tmp_path, capsys
):
    arguments = ["--params", str(write_params(max_steps=3))]
    assert run("", train_head.main, [*arguments, "--set", "train_head.device=cuda:77"]) == 2
    assert not (tmp_path / "params/head.part").exists(), "params alone are wrong"
    capsys.readouterr()

    file = flip(tmp_path / "params.zarr", "sensor/values")
    assert run("", train_head.main, arguments) == 2
    error = capsys.readouterr().err
    assert f"{file}: " in error
    assert "stages.verify --repair" in error
    assert not (tmp_path / "params/head.part").exists()

    assert run("", train_head.main, [*arguments, "--set", "train_head.check_store=false"]) == 0
    capsys.readouterr()
    # A finished run reads no number of the store, and is the same run with the check as without.
    assert run("", train_head.main, arguments) == 0
    assert "nothing to do" in capsys.readouterr().out
