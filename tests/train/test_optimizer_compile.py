"""torch.compile changes no number beyond float noise, and says what it lacks.

In a process of its own: torch.compile imports what warns.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from pipeline.base.errors import ConfigError
from pipeline.train.optimizer import compiled

ROOT = Path(__file__).resolve().parents[2]
TRAIN = """
import json, sys, torch
from pipeline.base.config import TrainHeadParams
from pipeline.train.split import split_by_episode
from pipeline.store import FeatureStore
from pipeline.train.loop import Trainer
from pipeline.train.run import open_run

store, params = FeatureStore.open(sys.argv[1]), TrainHeadParams.model_validate_json(sys.argv[2])
split = split_by_episode(store, params.split, params.horizon)
done = Trainer(store, params, split, open_run(params, store))
done.fit()
print(json.dumps(done.history.tensor().tolist()))
"""


def said(code: str, *arguments: object, **environment: str) -> str:
    env = os.environ | {"PYTHONPATH": str(ROOT)} | environment
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env=env, timeout=280)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_compiled_a_training_has_the_numbers_it_has_without(store, params, tmp_path):
    """Dropout, dropped streams, noise and flow times too; windows that no patch divides."""
    chosen = {
        "model_type": "flow_matching",
        "flow_matching": {"sampling_steps": 2},
        "drop_sensor": 0.3,
        "state_window": 13,
        "state_encoder": {"dim": 8, "layers": 1, "heads": 2, "output_dim": 8, "patch": 5},
        "max_steps": 6,
    }
    curves = {}
    for name, changed in {
        "eager": {},
        "compiled": {"compile": True},
        "other noise": {"seed": 1},
    }.items():
        given = params(**chosen | changed, output=tmp_path / name, logs=tmp_path / f"{name} logs")
        told = said(TRAIN, store.path, given.model_dump_json())
        curves[name] = torch.tensor(json.loads(told.splitlines()[-1]))
    assert torch.allclose(curves["compiled"], curves["eager"], rtol=1e-4, atol=1e-6)
    assert not torch.allclose(curves["other noise"], curves["eager"], rtol=1e-2)


def test_a_loss_that_does_not_compile_is_not_a_traceback(monkeypatch):
    from torch._dynamo.exc import BackendCompilerFailed

    def broken(function: Callable[..., Any], **chosen: object) -> Callable[..., Any]:
        def fails(*arguments: object) -> object:
            raise BackendCompilerFailed(torch.sin, RuntimeError("C++ compile error"), None)

        return fails

    monkeypatch.setattr(torch, "compile", broken)
    with pytest.raises(ConfigError, match=r"fails to compile this policy for cpu: .*C\+\+"):
        compiled(torch.sin, torch.device("cpu"))(torch.ones(2))
