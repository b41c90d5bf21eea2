"""The command proves, listens, says where, and stops cleanly."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.robot.client import PolicyClient
from stages import serve
from stages.command import run

ROOT = Path(__file__).resolve().parents[2]


@contextmanager
def served(
    trained: Path, *arguments: str
) -> Iterator[tuple[subprocess.Popen[str], str, list[str]]]:
    """The command as a process: where it serves, and what it said before."""
    process = subprocess.Popen(
        [sys.executable, "-m", "stages.serve", "--params", str(trained), *arguments],
        cwd=trained.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT), "VLA_SERVE_TOKEN": "s3cret"},
    )
    try:
        said: list[str] = []
        assert process.stdout is not None and process.stderr is not None
        for line in process.stdout:
            said.append(line)
            if (place := re.search(r"serving (ws://\S+)", line)) is not None:
                yield process, place[1], said
                break
        else:
            raise AssertionError(process.stderr.read())
    finally:
        process.kill()
        process.communicate()


def test_it_serves_until_it_is_told_to_stop(trained: Path, observe_phantom: dict[str, Any]) -> None:
    with served(trained) as (process, url, said):
        assert any("golden rows" in line for line in said)
        with PolicyClient(url, token="s3cret", timeout_s=60) as client:
            answer = client.infer(observe_phantom)
            assert np.isfinite(answer["actions"]).all()
            assert answer["actions"].shape == (client.metadata["horizon"], 7)
            process.send_signal(signal.SIGTERM)
            with pytest.raises(ConnectionError, match="stopping"):
                while True:
                    client.reset()
                    client.infer(observe_phantom)
        _, error = process.communicate(timeout=60)
        assert process.returncode == 1 and error == "stopped; run the same command again\n"


@pytest.fixture
def observe_phantom() -> dict[str, Any]:
    from pipeline.simulation.environment import InsertionEnvironment

    robot = InsertionEnvironment()
    readings, _ = robot.reset(seed=3)
    frames = {f"images/{view}": frame for view, (_, frame) in robot.frames().items()}
    return readings | frames | {"prompt": "Insert"}


def test_what_cannot_be_served_is_refused_by_name(trained, monkeypatch, capsys):
    monkeypatch.delenv("VLA_SERVE_TOKEN", raising=False)
    for override, message in (
        ("serve.checkpoint=nowhere", "expected a checkpoint"),
        ("serve.host=0.0.0.0", "serve.host: 0.0.0.0 can be reached by other machines"),
        ("serve.token_file=nowhere.txt", "serve.token_file: nowhere.txt: expected a token"),
        ("vlm.image_resize_width=112", "the policy was trained on other features"),
    ):
        assert run("", serve.main, ["--params", str(trained), "--set", override]) == 2
        assert message in capsys.readouterr().err
