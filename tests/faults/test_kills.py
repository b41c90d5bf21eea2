"""SIGKILL at random instants, several times over: the end is that of an undisturbed run."""

import itertools
import random
import signal
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

from pipeline.train.loop import Trainer
from stages import train_head
from stages.command import run

AHEAD = 4
"""Steps that a process goes on for and then waits, however late its kill comes."""


def train(params: Path, last: int, told: Connection) -> None:
    """Train, tell of each step, and wait for the end after the last one."""
    step, counts = Trainer._train_step, itertools.count(1)

    def slow(*arguments: Any) -> Any:
        done = step(*arguments)
        told.send("step")
        time.sleep(0.005 if next(counts) < last else 600)
        return done

    Trainer._train_step = slow
    run("", train_head.main, ["--params", str(params)])


@pytest.mark.parametrize(
    ("kills", "seed"), [(2, 0), *(pytest.param(8, n, marks=pytest.mark.slow) for n in range(1, 4))]
)
def test_a_training_killed_again_and_again(
    tiny_store, head_params, fork, here, tmp_path, kills, seed
):
    """Between checkpoints, while one is written, while it is judged: wherever the kill falls."""
    chance = random.Random(seed)
    path = tiny_store(tmp_path)
    pace = {"max_steps": (12 + AHEAD) * kills + 4}
    killed, whole = (head_params(path, name, train_head=pace) for name in ("killed", "whole"))
    for _ in range(kills):
        steps = chance.randint(1, 12)
        process, heard = fork(train, killed, steps + AHEAD)
        for _ in range(steps):
            heard.recv()
        time.sleep(chance.uniform(0.0, 0.02))
        process.kill()
        process.join()
        assert process.exitcode == -signal.SIGKILL
    for params in (killed, whole):
        code, _, complained = here("stages.train_head", params)
        assert code == 0, complained
    for name in ("best", "last"):
        weights = [
            (tmp_path / run / "head" / name / "policy.safetensors").read_bytes()
            for run in ("killed", "whole")
        ]
        assert weights[0] == weights[1]
    assert not list((tmp_path / "killed").glob("head.part*"))
