"""A policy of the phantom, a stand-in for its model and a server in this process."""

import gc
import socket
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.base.config import Params, ServeParams, TrainHeadParams, load_params
from pipeline.compat.unified import no_normalization
from pipeline.data.insertion import SENSOR, STATE
from pipeline.policy.checkpoint import PolicyCheckpoint, find_policy, load_policy
from pipeline.policy.observation import PolicyShape
from pipeline.policy.policy import Policy
from pipeline.robot import loop_process
from pipeline.robot.loop_process import PolicyThread
from pipeline.robot.server import PolicyServer, listen
from pipeline.robot.session import ServedPolicy
from pipeline.simulation.insertion import INSTRUCTION
from pipeline.simulation.rendering import VIEWS

SLOTS, DIM = 2, 4
GROUPS = ("translation",) * 3 + ("rotation",) * 3 + ("gripper",)
SOURCE = {
    "feature_spec": {"digest": "abc", "views": list(VIEWS)},
    "streams": {
        "action": {
            "names": ["dx", "dy", "dz", "rx", "ry", "rz", "gripper"],
            "units": ["mm"] * 3 + ["deg"] * 3 + [""],
            "kind": "delta",
        },
        "state": {"names": list(STATE.names), "units": list(STATE.units)},
        "sensor": {"names": list(SENSOR.names), "units": list(SENSOR.units)},
        "views": list(VIEWS),
    },
    "action_hz": 10.0,
    "vlm_reuse_count": 3,
}


class Glance:
    """Stands for the model: features are the means of the frames; remembers its passes."""

    def __init__(self) -> None:
        self.passes: list[list[dict[str, Any]]] = []
        self.instructions: list[str] = []
        self.before: Callable[[], Any] = lambda: None
        """Called as a pass begins."""

    def __call__(self, frames: list[dict[str, Any]], instruction: str) -> Any:
        self.before()
        self.passes.append(frames)
        self.instructions.append(instruction)
        features = torch.zeros(len(frames), SLOTS, DIM)
        valid = torch.zeros(len(frames), SLOTS, dtype=torch.bool)
        for row, views in enumerate(frames):
            for slot, view in enumerate(VIEWS[:SLOTS]):
                if view in views:
                    means = views[view].mean(axis=(0, 1)) / 255
                    features[row, slot, :3] = torch.tensor(means)
                    valid[row, slot] = True
        return features, valid

    def key(self, frames: dict[str, Any], instruction: str) -> bytes:
        newest = sum(int(frame.sum()) for frame in frames.values())
        return newest.to_bytes(8, "little") + instruction.encode()[:8].ljust(8)


def build_policy(
    model_type: str = "regression", views: int = len(VIEWS), **changed: Any
) -> tuple[PolicyCheckpoint, Policy, Glance]:
    """A policy of few random weights for the phantom, its checkpoint, a stand-in for its model."""
    params = TrainHeadParams.model_validate(
        {
            "model_type": model_type,
            "horizon": 4,
            "sensor_window": 10,
            "state_window": 10,
            "sensor_encoder": {"channels": [8], "layers": 0, "heads": 1, "output_dim": 8},
            "state_encoder": {"dim": 8, "layers": 0, "heads": 1, "output_dim": 8},
            "expert": {"dim": 8, "layers": 1, "heads": 1},
        }
        | changed
    )
    shape = PolicyShape(SLOTS, DIM, 1026, 12, 7, GROUPS, views=views)
    normal = no_normalization(shape)
    # So that a random policy moves by tenths of a millimetre.
    action = replace(normal.action, std=np.full(7, 0.05), mean=np.array([0, 0, -0.1, 0, 0, 0, 1.0]))
    normal = replace(normal, action=action)
    torch.manual_seed(0)
    policy = Policy(params, shape, normal).eval()
    held = {"split": {"train": {}, "val": {}, "test": {}}, "step": 1, "weights": {}}
    told = (INSTRUCTION,)
    checkpoint = PolicyCheckpoint(params, shape, normal, SOURCE, **held, instructions=told)
    return checkpoint, policy, Glance()


def watch(monkeypatch: pytest.MonkeyPatch, policy: Policy) -> list[dict[str, np.ndarray]]:
    """What the policy is given in each pass, by field (robot, …); it grows with every pass."""
    given, observe = list[dict[str, np.ndarray]](), policy.observe

    def watched(streams: Any) -> Any:
        given.append({name: np.array(value) for name, value in streams.items()})
        return observe(streams)

    monkeypatch.setattr(policy, "observe", watched)
    return given


class Blocked:
    """Keeps the model of a served policy waiting, once it has begun to look, until `go`."""

    def __init__(self, served: Any) -> None:
        self.looking, self.go = threading.Event(), threading.Event()
        served.glance.before = self

    def __call__(self) -> None:
        self.looking.set()
        assert self.go.wait(60)


class SimulatedTime:
    """A clock that only sleeping moves."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


class SimulatedThread(PolicyThread):
    """Infers where it is asked; the answer comes when the simulated latency is over."""

    def ask(self, question: Mapping[str, Any]) -> None:
        self.busy = True
        self._answer(question)
        policy = getattr(self._infer, "__self__", None)
        self._due_s = loop_process.time.monotonic() + getattr(policy, "latency_s", 0.0)

    def take(self) -> Mapping[str, Any] | None:
        return (
            super().take()
            if self.busy and loop_process.time.monotonic() >= self._due_s - 1e-9
            else None
        )


@pytest.fixture
def simulated_time(monkeypatch: pytest.MonkeyPatch) -> SimulatedTime:
    """The clock of `run_robot`, so that a busy machine changes nothing: only sleeping moves it, and
    an answer comes when the policy's `latency_s` is over."""
    simulated = SimulatedTime()
    for module in ("realtime", "readings", "loop_process", "run_report"):
        monkeypatch.setattr(f"pipeline.robot.{module}.time", simulated)
    monkeypatch.setattr("pipeline.robot.realtime.PolicyThread", SimulatedThread)
    monkeypatch.setattr(gc, "collect", lambda: 0)  # a third of a second each, for nothing here
    return simulated


@pytest.fixture
def served_policy() -> Any:
    """`served_policy(model_type, ...)`: the same, served; it has `glance`."""
    all_served: list[ServedPolicy] = []

    def build(
        model_type: str = "regression", look: Any = None, told: Any = None, **changed: Any
    ) -> Any:
        checkpoint, policy, glance = build_policy(model_type, **changed)
        if told is not None:
            checkpoint = replace(checkpoint, instructions=tuple(told))
        features: Any = glance if "features" in policy.encoders else None
        served: Any = ServedPolicy(checkpoint, policy, features, "models/head", look)
        served.glance = glance
        all_served.append(served)
        return served

    yield build
    for served in all_served:
        served.close()


@pytest.fixture(scope="session")
def observe() -> Callable[..., dict[str, Any]]:
    """`observe(tick, field=value, ...)`: what the phantom's robot says at a tick; None leaves a
    field out."""

    def made(tick: int = 0, **changed: Any) -> dict[str, Any]:
        rng = np.random.default_rng(tick)
        begun = 0.1 * tick
        fields = {
            "state": rng.normal(size=(10, 12)).astype(np.float32),
            "state_time": begun + np.arange(1, 11) / 100,
            "sensor": rng.normal(size=(65, 1026)).astype(np.float32),
            "sensor_time": begun + np.arange(1, 66) / 650,
            "time": np.array([begun + 0.1]),
        }
        fields |= {
            f"images/{view}": rng.integers(0, 256, (12, 20, 3), dtype=np.uint8) for view in VIEWS
        }
        return {name: own for name, own in (fields | changed).items() if own is not None}

    return made


@pytest.fixture
def serving() -> Any:
    """`serving(served, token=None, key=value, ...)`: a server of it in a thread, which ends with
    the test; the keys are those of the section `serve`. It has the `lines` that it wrote."""
    running: list[tuple[PolicyServer, threading.Thread, socket.socket]] = []

    def start(served: Any, token: str | None = None, **changed: Any) -> PolicyServer:
        params = ServeParams.model_validate({"port": 0} | changed)
        bound = listen(params)
        server: Any = PolicyServer(served, params, token, bound, (lines := list[str]()).append)
        server.lines = lines
        up = threading.Event()
        thread = threading.Thread(target=server.run, args=(up.set,))
        thread.start()
        running.append((server, thread, bound))
        assert up.wait(20)
        return server

    yield start
    for server, thread, bound in running:
        if thread.is_alive():
            server.stop()
        thread.join(20)
        assert not thread.is_alive()
        bound.close()


@pytest.fixture(scope="session")
def params(trained_once: Path) -> Params:
    """Params of two recorded episodes, whose store is extracted and whose head is trained."""
    return load_params(trained_once)


@pytest.fixture(scope="session")
def checkpoint(params: Params) -> PolicyCheckpoint:
    """The policy of that training."""
    return load_policy(find_policy(params.train_head.output))
