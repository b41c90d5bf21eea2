"""From whichever step a run goes on, it does what it would have done."""

import shutil
from typing import Any

import pytest
import torch

from pipeline.base.errors import CheckpointMismatch
from pipeline.train.loop import Trainer, load_weights

STEPS = 4


def weights(trainer: Trainer) -> list[torch.Tensor]:
    both = (trainer.policy.state_dict(), trainer.averaged.state_dict())
    return [value.clone() for state in both for value in state.values()]


def test_every_step_can_be_gone_on_from(store, params, trainer, tmp_path, monkeypatch):
    chosen = {
        "model_type": "diffusion",
        "grad_accumulation": 2,
        "max_steps": STEPS,
        "warmup_steps": 2,
        "eval_every": 2,
        "checkpoint_every": 1,
        "drop_sensor": 0.3,
        "diffusion": {"sampling_steps": 2},
    }
    kept = tmp_path / "kept"
    real = Trainer._save_last

    def keeping(self: Trainer, *rest: Any) -> None:
        real(self, *rest)
        shutil.copytree(self.run.part, kept / str(self.step))

    with monkeypatch.context() as patched:
        patched.setattr(Trainer, "_save_last", keeping)
        whole = trainer(store, params(**chosen))
        whole.fit()
    for step in range(1, STEPS + 1):
        output = tmp_path / f"from_{step}"
        shutil.copytree(kept / str(step), output.with_name(f"{output.name}.part"))
        resumed = trainer(store, params(**chosen, output=output, logs=tmp_path / f"logs_{step}"))
        assert (resumed.run.status, resumed.step) == ("resumed", step)
        resumed.fit()
        assert torch.equal(resumed.history.tensor(), whole.history.tensor())
        for a, b in zip(weights(resumed), weights(whole), strict=True):
            assert torch.equal(a, b)
        assert resumed.stopping == whole.stopping


def test_weights_of_another_module_are_refused(tmp_path):
    stored = {"head.weight": torch.ones(2, 3)}
    for name, shape in (("head.weight", (3, 2)), ("tail.weight", (2, 3))):
        learning = {name: torch.nn.Parameter(torch.zeros(shape))}
        with pytest.raises(CheckpointMismatch, match="expected what learns in this run"):
            load_weights(learning, stored, tmp_path)
