"""From whichever step a run goes on, it does what it would have done."""

import shutil
from typing import Any

import pytest
import torch

from pipeline.base.errors import CheckpointMismatch
from pipeline.train.checkpoints import load_weights
from pipeline.train.loop import Trainer
from pipeline.train.process_group import ProcessGroup
from pipeline.train.run import open_run

STEPS = 4


def weights(trainer: Trainer) -> list[torch.Tensor]:
    both = (trainer.policy.state_dict(), trainer.averaged.state_dict())
    return [value.clone() for state in both for value in state.values()]


@pytest.mark.parametrize(
    "model_type",
    [
        "diffusion",
        pytest.param("regression", marks=pytest.mark.slow),
        pytest.param("flow_matching", marks=pytest.mark.slow),
    ],
)
def test_every_step_can_be_gone_on_from(store, params, trainer, tmp_path, monkeypatch, model_type):
    chosen = {
        "model_type": model_type,
        "grad_accumulation": 2,
        "max_steps": STEPS,
        "warmup_steps": 2,
        "eval_every": 2,
        "checkpoint_every": 1,
        "drop_sensor": 0.3,
        "sensor_lr": 1e-3,
        "diffusion": {"sampling_steps": 2},
        "flow_matching": {"sampling_steps": 2},
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


@pytest.fixture(scope="module")
def of_two_parts(store, params_below, trainer, tmp_path_factory):
    """A finished run of two parts a step, to be copied."""
    chosen = params_below(tmp_path_factory.mktemp("parts"), grad_accumulation=2, max_steps=2)
    trainer(store, chosen).fit()
    return chosen.output


@pytest.mark.parametrize(
    ("size", "accumulation", "status"), [(2, 1, "finished"), (1, 4, "new"), (2, 2, "new")]
)
def test_parts_may_be_shared_out_anew_but_not_cut_anew(
    store, params, monkeypatch, of_two_parts, size, accumulation, status
):
    """What one process of two parts did is the run of two processes of one part, and no other."""
    shutil.copytree(of_two_parts, params().output)
    monkeypatch.setenv("WORLD_SIZE", str(size))
    monkeypatch.setattr(ProcessGroup, "current", lambda: ProcessGroup(0, size))
    given = params(grad_accumulation=accumulation, max_steps=2)
    assert open_run(given, store).status == status
    assert open_run(given, store, {"adapter": "another"}).status == "new"


def test_weights_of_another_module_are_refused(tmp_path):
    stored = {"head.weight": torch.ones(2, 3)}
    for name, shape in (("head.weight", (3, 2)), ("tail.weight", (2, 3))):
        learning = {name: torch.nn.Parameter(torch.zeros(shape))}
        with pytest.raises(CheckpointMismatch, match="expected what learns in this run"):
            load_weights(learning, stored, tmp_path)
