"""SIGKILL at random instants, several times over: the end is that of an undisturbed run."""

import itertools
import random
import signal
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

from pipeline.train.loop import Trainer
from stages import train_head
from stages.command import run

AHEAD = 4
"""Steps or writes that a process goes on for and then waits, however late its kill comes."""


def paced(owner: type, name: str, last: int, told: Connection) -> None:
    """Have a process tell of each call of a method, and wait for its end after the last one."""
    work, counts = getattr(owner, name), itertools.count(1)

    def slow(*arguments: Any) -> Any:
        done = work(*arguments)
        told.send(name)
        time.sleep(0.005 if next(counts) < last else 600)
        return done

    setattr(owner, name, slow)


def train(params: Path, last: int, told: Connection) -> None:
    """Train, and tell of each step."""
    paced(Trainer, "_train_step", last, told)
    run("", train_head.main, ["--params", str(params)])


@pytest.fixture
def kill_after(fork) -> Callable[..., None]:
    """`kill_after(count, wait_s, work, ...)`: SIGKILL it so long after it told so often."""

    def kill(count: int, wait_s: float, work: Callable[..., None], *arguments: Any) -> None:
        process, heard = fork(work, *arguments, count + AHEAD)
        for _ in range(count):
            heard.recv()
        time.sleep(wait_s)
        process.kill()
        process.join()
        assert process.exitcode == -signal.SIGKILL

    return kill


@pytest.mark.parametrize(
    ("kills", "seed"), [(2, 0), *(pytest.param(8, n, marks=pytest.mark.slow) for n in range(1, 4))]
)
def test_a_training_killed_again_and_again(
    tiny_store, head_params, kill_after, here, tmp_path, kills, seed
):
    """Between checkpoints, while one is written, while it is judged: wherever the kill falls."""
    chance = random.Random(seed)
    path = tiny_store(tmp_path)
    steps = {"max_steps": (12 + AHEAD) * kills + 4}
    killed, whole = (head_params(path, name, train_head=steps) for name in ("killed", "whole"))
    for _ in range(kills):
        kill_after(chance.randint(1, 12), chance.uniform(0.0, 0.02), train, killed)
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
