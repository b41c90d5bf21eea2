"""The command proves, listens, says where, and stops cleanly."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline.robot.client import PolicyClient
from pipeline.simulation.environment import InsertionEnvironment
from stages import serve
from stages.command import run

ROOT = Path(__file__).resolve().parents[2]


def test_it_serves_until_it_is_told_to_stop(trained: Path) -> None:
    robot = InsertionEnvironment()
    readings, _ = robot.reset(seed=3)
    frames = {f"images/{view}": frame for view, (_, frame) in robot.frames().items()}
    observed = readings | frames | {"prompt": "Insert"}
    process = subprocess.Popen(
        [sys.executable, "-m", "stages.serve", "--params", str(trained)],
        cwd=trained.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT), "VLA_SERVE_TOKEN": "s3cret"},
    )
    assert process.stdout is not None and process.stderr is not None
    try:
        said = ""
        while (place := re.search(r"serving (ws://\S+)", said)) is None:
            line = process.stdout.readline()
            assert line, process.stderr.read()
            said += line
        assert "golden rows" in said
        with PolicyClient(place[1], token="s3cret", timeout_s=60) as client:
            answer = client.infer(observed)
            assert np.isfinite(answer["actions"]).all()
            assert answer["actions"].shape == (client.metadata["horizon"], 7)
            process.send_signal(signal.SIGTERM)
            with pytest.raises(ConnectionError, match="stopping"):
                while True:
                    client.reset()
                    client.infer(observed)
        _, error = process.communicate(timeout=60)
        assert process.returncode == 1 and error == "stopped; run the same command again\n"
    finally:
        process.kill()
        process.communicate()


def test_what_cannot_be_served_is_refused_by_name(trained, monkeypatch, capsys):
    monkeypatch.delenv("VLA_SERVE_TOKEN", raising=False)
    for override, message in (
        ("serve.checkpoint=nowhere", "expected a checkpoint"),
        ("serve.host=0.0.0.0", "serve.host: 0.0.0.0 can be reached by other machines"),
    ):
        assert run("", serve.main, ["--params", str(trained), "--set", override]) == 2
        assert message in capsys.readouterr().err
