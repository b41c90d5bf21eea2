"""Two processes that torchrun started do what one does, and stop together."""

import json
import os
import runpy
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
import yaml

from pipeline.base.config import load_params
from pipeline.base.errors import ConfigError
from pipeline.policy.checkpoint import load_policy
from pipeline.store import FeatureStore, build_lock
from pipeline.train.loop import Trainer
from pipeline.train.process_group import ProcessGroup, process_device, process_group

ROOT = Path(__file__).resolve().parents[2]
FAILURES = ("open 0", "open 1", "step 1")
"""Where one process alone fails, and its rank."""
Make = Callable[..., Any]
TRAIN = """
import contextlib, io, json, os, sys, time
from datetime import timedelta
from pathlib import Path
import torch.distributed as dist
import pipeline.train.loop as loop
from pipeline.base.errors import StoreIncomplete
from pipeline.store import FeatureStore
from pipeline.train import process_group
from stages import train_head
from stages.command import run

loop.LOG_EVERY = 1
step, fitted, opened = loop.Trainer._train_step, loop.Trainer.fit, vars(FeatureStore)["open"]
rank = os.environ["RANK"]

def train_step(self, batches, interrupted):
    stopped = step(self, batches, interrupted)
    if self.step == hold:
        if self.processes.first:
            print("holding", flush=True)
        while not interrupted():
            time.sleep(0.01)
    return stopped

def fail(*rest, **named):
    raise StoreIncomplete(f"no store on the machine of {rank}")

def fit(self):
    self.learn = fail
    fitted(self)

def train(arguments, fails="", holds=None):
    global hold
    hold = holds
    # Rank 0 is waited for where it fails too, however late; where it does not, for a moment.
    alone = fails.endswith("1")
    process_group.PRECEDENCE = timedelta(seconds=0.2 if alone else 200)
    FeatureStore.open = fail if fails == f"open {rank}" else opened
    loop.Trainer.fit = fit if fails == f"step {rank}" else fitted
    return run("", train_head.main, arguments)

case = json.loads(sys.argv[1])
if isinstance(case, dict):
    loop.Trainer._train_step = train_step
    sys.exit(train(**case))
prefix, found = dist.PrefixStore, []
for number, one in enumerate(case):
    # A meeting of its own for each, at the port of all.
    dist.PrefixStore = lambda name, store: prefix(f"{number} {name}", store)
    with contextlib.redirect_stderr(io.StringIO()) as err:
        try:
            code = train(**one)
        except SystemExit as end:
            code = end.code
    found.append((code, err.getvalue()))
Path(sys.argv[2] + rank).write_text(json.dumps(found))
"""
PRIMITIVES = """
import torch
from torch import nn
from pipeline.base.errors import StoreLocked
from pipeline.train.process_group import process_group
from pipeline.train.process_group import FirstProcessFailed

with process_group("cpu") as processes:
    rank = float(processes.rank)
    assert processes.size == 2
    assert processes.shared(lambda: ("only", processes.rank)) == ("only", 0)
    kept = {"a": torch.full((2, 3), 7.0), "n": torch.tensor(5)}
    found = processes.tensors(kept if processes.first else {})
    assert found["a"].tolist() == [[7.0] * 3] * 2 and found["n"].item() == 5
    double = torch.tensor([rank], dtype=torch.float64)
    several = [torch.full((3,), rank), torch.tensor(rank + 1), double]
    processes.sum(several)
    assert [t.tolist() for t in several] == [[1.0] * 3, 3.0, [1.0]]
    # One parameter used by rank 1 alone, one by both, one by none.
    used = nn.ParameterList(torch.zeros(2) for _ in range(3))
    used[0].grad = torch.ones(2) if processes.rank == 1 else None
    used[1].grad = torch.full((2,), rank + 1)
    loss = {"loss": torch.tensor(rank)}
    assert processes.sum_gradients(used, loss, stop=processes.rank == 1)
    assert used[0].grad.tolist() == [1.0, 1.0]
    assert used[1].grad.tolist() == [3.0, 3.0]
    assert used[2].grad is None
    assert loss["loss"].item() == 1.0
    def locked():
        raise StoreLocked("held by another")
    try:
        processes.shared(locked)
    except StoreLocked:
        assert processes.first
    except FirstProcessFailed as error:
        assert not processes.first and "held by another" in str(error)
    else:
        raise AssertionError("a failure on rank 0 went unheard")
    print("done", processes.rank, flush=True)
"""


def torchrun(script: Path, *arguments: object) -> "subprocess.Popen[str]":
    """Two processes on this machine, which meet at a port of their own."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
    return subprocess.Popen(
        [*command, str(script), *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )


def ranked(rank: int, port: int, said: Path, script: Path, *arguments: object) -> None:
    """Run a script as torchrun would, as one of two processes that meet at a store of another."""
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": "2"}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    os.environ["TORCHELASTIC_USE_AGENT_STORE"] = "True"
    descriptor = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    for standard in (1, 2):
        os.dup2(descriptor, standard)
    sys.argv = [str(script), *map(str, arguments)]
    runpy.run_path(str(script), run_name="__main__")


@pytest.fixture
def two_ranks(fork_server, tmp_path):
    """`two_ranks(script, ...)`: what the two processes have said, which must end well.

    Forked, and without torchrun, which imports for seconds and adds nothing to what they say to
    each other.
    """

    def run(script: Path, *arguments: object) -> str:
        meeting = dist.TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
        said = tmp_path / "said"
        processes = [
            fork_server.Process(target=ranked, args=(rank, meeting.port, said, script, *arguments))
            for rank in range(2)
        ]
        for process in processes:
            process.start()
        for process in processes:
            process.join()
        assert [process.exitcode for process in processes] == [0, 0], said.read_text()
        return said.read_text()

    return run


@pytest.fixture
def script(tmp_path):
    path = tmp_path / "train.py"
    path.write_text(TRAIN)
    return path


@pytest.fixture
def write(store, params, tmp_path):
    """`write(name, key=value, ...)`: a params.yaml of small params."""

    def make(name: str, **changed: Any) -> Path:
        places = {"output": tmp_path / name, "logs": tmp_path / f"{name}_logs"}
        # Nine ticks cannot be halved, and chunks near an episode's end have fewer steps.
        head = params(**{"batch_size": 9, "horizon": 9} | places | changed)
        document = {
            "data": {"sources": [{"name": "left", "path": "a"}, {"name": "right", "path": "b"}]},
            "vlm": {"checkpoint": "unused"},
            "extract": {"store": str(store.path)},
            "train_head": head.model_dump(mode="json"),
        }
        path = tmp_path / f"{name}.yaml"
        path.write_text(yaml.safe_dump(document))
        return path

    return make


def case(written: Path, **how: Any) -> dict[str, Any]:
    """A training of these params: `fails="PLACE RANK"` there, `holds=STEP` till it is stopped."""
    return {"arguments": ["--params", str(written)]} | how


def curves(logs: Path) -> dict[str, list[float]]:
    return {
        str(file.relative_to(logs)): [
            float(line.split("\t")[1]) for line in file.read_text().splitlines()[1:]
        ]
        for file in logs.rglob("*.tsv")
    }


def train_alone(trainer: Make, store: FeatureStore, written: Path) -> Trainer:
    done = trainer(store, load_params(written).train_head)
    done.fit()
    return done


def same(one: Path, other: Path) -> bool:
    """Whether two checkpoints have the same weights within float noise."""
    a, b = load_policy(one).weights, load_policy(other).weights
    return all(torch.allclose(a[name], b[name], rtol=1e-3, atol=1e-5) for name in a)


@pytest.mark.extra
def test_two_processes_follow_the_curve_of_one_that_accumulates(
    store, trainer, write, script, two_ranks, tmp_path, monkeypatch
):
    """With dropout, uneven parts and accumulation on each; both stop early at the same step."""
    pytest.importorskip("tensorboard", reason="tensorboard is not installed")
    chosen = {
        "max_steps": 24,
        "eval_every": 2,
        "early_stopping": 1,
        "ema_decay": 0.0,
        "drop_sensor": 0.3,
        "loggers": ["tensorboard"],
    }
    together = write("together", grad_accumulation=2, **chosen)
    out = two_ranks(script, json.dumps(case(together)))
    monkeypatch.setattr("pipeline.train.loop.LOG_EVERY", 1)
    done = train_alone(trainer, store, write("alone", grad_accumulation=4, **chosen))
    assert "device cpu on 2 processes" in out
    assert out.count("parameters") == 1, "one process speaks"
    assert f"stopped early at step {done.step}" in out
    assert done.step < 24
    found, expected = curves(tmp_path / "together_logs"), curves(tmp_path / "alone_logs")
    assert set(found) == set(expected)
    for name, values in expected.items():
        assert found[name] == pytest.approx(values, rel=1e-3, abs=1e-5), name
    assert same(tmp_path / "together/last", tmp_path / "alone/last")
    assert len(list((tmp_path / "together_logs.tensorboard").iterdir())) == 1, "one process logs"
    assert out.count("live: ") == 2


def test_a_signal_to_torchrun_stops_all_after_one_step_and_one_process_can_go_on(
    store, trainer, write, script, tmp_path
):
    written = write("together", model_type="diffusion", checkpoint_every=1000, max_steps=12)
    process = torchrun(script, json.dumps(case(written, holds=6)))
    assert process.stdout is not None
    while "holding" not in (line := process.stdout.readline()):
        assert line, "ended before step 6"
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate()
    assert err.count("stopped; run the same command again") == 1
    last = json.loads((tmp_path / "together.part/last/trainer.json").read_text())
    assert last["step"] == 7
    head = load_params(written, ["train_head.grad_accumulation=2"]).train_head
    resumed = trainer(store, head)
    assert (resumed.run.status, resumed.step) == ("resumed", 7)
    resumed.fit()
    train_alone(
        trainer, store, write("alone", model_type="diffusion", max_steps=12, grad_accumulation=2)
    )
    assert same(tmp_path / "together/last", tmp_path / "alone/last")


def test_what_goes_wrong_is_said_once_and_nobody_waits(write, script, two_ranks, tmp_path):
    """One case after the other between the same two processes, which must all end each."""
    cases = [
        (case(write("diverging", lr=1e3, weight_decay=1e3)), "error: step"),
        (case(write("held")), "being built by"),
        (case(write("nowhere", store="nowhere.zarr")), "no finished store"),
        (case(write("cuda", device="cuda:0")), "expected auto, cpu or cuda for 2 processes"),
        *(
            (case(write(fails), fails=fails), f"no store on the machine of {fails[-1]}")
            for fails in FAILURES
        ),
    ]
    with build_lock(tmp_path / "held"):
        two_ranks(script, json.dumps([one for one, _ in cases]), tmp_path / "found")
    found = [json.loads((tmp_path / f"found{rank}").read_text()) for rank in range(2)]
    for (one, said), of_first, of_other in zip(cases, *found, strict=True):
        alone = one.get("fails", "").endswith("1")
        speaks, quiet = (of_other, of_first) if alone else (of_first, of_other)
        assert (speaks[0], quiet[0]) == (2, 2), one
        assert speaks[1].count("error: ") == 1
        assert speaks[1].count(said) == 1
        assert ("error: process of rank 1: " in speaks[1]) == alone
        assert quiet[1] == ""


@pytest.mark.slow
def test_a_process_that_fails_alone_ends_torchrun(write, script):
    process = torchrun(script, json.dumps(case(write("together"), fails="step 1")))
    _, err = process.communicate()
    assert process.returncode == 1
    assert err.count("error: ") == 1
    assert err.count("error: process of rank 1: no store on the machine of 1") == 1
    assert "stopped; the same command" not in err
    assert "Connection closed" not in err


def test_what_processes_tell_each_other(two_ranks, tmp_path):
    script = tmp_path / "primitives.py"
    script.write_text(PRIMITIVES)
    said = two_ranks(script)
    assert "done 0" in said
    assert "done 1" in said


def test_a_process_alone_is_a_group_of_one():
    processes = ProcessGroup.current()
    assert (processes.rank, processes.size, processes.first) == (0, 1, True)
    with pytest.raises(ConfigError), process_group("cpu") as group:
        assert group == processes
        raise ConfigError("as it is")


def test_an_incomplete_environment_is_named(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "0")
    with pytest.raises(ConfigError, match="LOCAL_RANK, MASTER_ADDR, MASTER_PORT is missing"):
        process_group("cpu").__enter__()


def test_every_process_has_a_gpu_of_its_own(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("LOCAL_RANK", "1")
    with pytest.raises(ConfigError, match=r"cuda:0: expected auto, cpu or cuda for 2 processes"):
        process_device("cuda:0")
    assert process_device("cpu").type == "cpu"
    asked: list[str] = []
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("pipeline.train.process_group.resolve_device", asked.append)
    for name in ("auto", "cuda"):
        process_device(name)
    assert asked == ["cuda:1", "cuda:1"]
