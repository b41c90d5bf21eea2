"""SIGKILL at random instants, several times over: the end is that of an undisturbed run."""

import random
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

SLOWED = """
import sys, time
from pipeline.training import Trainer
from stages import train_head
from stages.command import run

step = Trainer._train_step
def slow(self, *rest):
    stopped = step(self, *rest)
    print("step", self.step, flush=True)
    time.sleep(0.01)
    return stopped
Trainer._train_step = slow
sys.exit(run("", train_head.main, sys.argv[1:]))
"""


@pytest.mark.parametrize(
    ("kills", "seed"), [(3, 0), *(pytest.param(8, n, marks=pytest.mark.slow) for n in range(1, 4))]
)
def test_a_training_killed_again_and_again(
    tiny_store: Callable[..., Path], head_params, start, stage, tmp_path: Path, kills, seed
) -> None:
    """Between checkpoints, while one is written, while it is judged: wherever the kill falls."""
    chance = random.Random(seed)
    store = tiny_store(tmp_path)
    killed, whole = head_params(store, "killed"), head_params(store, "whole")
    for _ in range(kills):
        process = start(SLOWED, killed)
        steps = chance.randint(1, 12)
        assert process.stdout is not None
        while steps and (line := process.stdout.readline()):
            steps -= line.startswith("step ")
        time.sleep(chance.uniform(0.0, 0.02))
        assert process.poll() is None, "the kill came too late to test anything"
        process.send_signal(signal.SIGKILL)
        process.communicate()
    for params in (killed, whole):
        code, _, complained = stage("stages.train_head", params)
        assert code == 0, complained
    for name in ("best", "last"):
        weights = [
            (tmp_path / run / "head" / name / "policy.safetensors").read_bytes()
            for run in ("killed", "whole")
        ]
        assert weights[0] == weights[1]
    assert not list((tmp_path / "killed").glob("head.part*"))


MERGING = """
import sys, time
from pipeline.store import writer
from stages import store
from stages.command import run

write = writer.ChunkFiles.write
def slow(self, *rest):
    print("write", flush=True)
    time.sleep(0.005)
    write(self, *rest)
writer.ChunkFiles.write = slow
sys.exit(run("", store.main, sys.argv[1:], store.SHORTHANDS))
"""


def test_a_merge_killed_again_and_again(
    tiny_store: Callable[..., Path], head_params, start, stage, tmp_path: Path
) -> None:
    chance = random.Random(0)
    inputs = [str(tiny_store(tmp_path, name=name, seed=seed)) for seed, name in enumerate("ab")]
    params = head_params(Path("unused.zarr"))
    words = ["merge", *inputs, "--into"]
    for _ in range(3):
        process = start(MERGING, params, *words, str(tmp_path / "killed.zarr"))
        writes = chance.randint(1, 40)
        assert process.stdout is not None
        while writes and (line := process.stdout.readline()):
            writes -= line == "write\n"
        assert process.poll() is None, "the kill came too late to test anything"
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert not (tmp_path / "killed.zarr").exists()
    for name in ("killed", "whole"):
        code, _, complained = stage("stages.store", params, *words, str(tmp_path / f"{name}.zarr"))
        assert code == 0, complained
    held = [
        {path.relative_to(place): path.read_bytes() for path in place.rglob("*") if path.is_file()}
        for place in (tmp_path / "killed.zarr", tmp_path / "whole.zarr")
    ]
    assert held[0] == held[1]
