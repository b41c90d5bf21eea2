"""What going on with a run takes beyond its policy, as safetensors and JSON, and the way back."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from pipeline.base.differences import describe, differences
from pipeline.base.durable import (
    damaged,
    read_document,
    read_tensors,
    write_tensors,
    write_with_digest,
)
from pipeline.base.errors import CheckpointIncomplete, CheckpointMismatch
from pipeline.policy.checkpoint import load_policy
from pipeline.policy.normalization import Normalization
from pipeline.policy.observation import PolicyShape
from pipeline.train.log import Row
from pipeline.train.run import TRAINER_DOCUMENT, TRAINER_WEIGHTS, TrainingRun
from pipeline.train.world import World


@dataclass(frozen=True)
class TrainerState:
    """A run after `step` steps.

    There is no random state and no schedule state in it: both follow from the seed and the step.
    """

    step: int
    columns: Sequence[str]
    """Of the history."""
    best_error: float | None
    stalled: int
    """Evaluations since the best one."""
    trained_s: float
    """Seconds of training so far, over all starts."""
    rows: Sequence[Row]
    tensors: Mapping[str, Tensor]
    """What learns (`weights:<name in the trained module>`), the moving `average:` of each, the
    `optimizer:` state and the `history:`, a row for every step so far."""

    def part(self, kind: str) -> dict[str, Tensor]:
        """The tensors of one kind, by name."""
        return {
            key.removeprefix(f"{kind}:"): value
            for key, value in self.tensors.items()
            if key.startswith(f"{kind}:")
        }


def write_trainer(folder: Path, state: TrainerState) -> None:
    """Write the two files of a trainer's state into an existing folder."""
    document = {key: value for key, value in vars(state).items() if key != "tensors"}
    document["weights_sha256"] = write_tensors(folder / TRAINER_WEIGHTS, state.tensors)
    write_with_digest(folder / TRAINER_DOCUMENT, document)


def read_trainer(folder: Path) -> TrainerState:
    """The state at `folder`; `CheckpointIncomplete` where a file is missing or damaged."""
    path = folder / TRAINER_DOCUMENT
    try:
        document = read_document(path)
        tensors = read_tensors(folder / TRAINER_WEIGHTS, document.pop("weights_sha256"))
        return TrainerState(**document, tensors=tensors)
    except (KeyError, TypeError) as error:
        why = f"not what it must hold ({type(error).__name__}: {error})"
        raise CheckpointIncomplete(damaged(path, why)) from None


@torch.no_grad()
def load_weights(
    parameters: Mapping[str, nn.Parameter], tensors: Mapping[str, Tensor], place: Path
) -> None:
    """Lay the tensors into the parameters of the same names.

    Raises `CheckpointMismatch` where names or shapes are others.
    """
    wanted = {name: tuple(value.shape) for name, value in parameters.items()}
    stored = {name: tuple(value.shape) for name, value in tensors.items()}
    if differing := describe(differences(stored, wanted)):
        raise CheckpointMismatch(
            f"{place}: expected what learns in this run, {len(wanted)} parameters; {differing[0]} "
            f"(the checkpoint -> the run). Remove {place} to begin anew, or use the version of "
            "this code that wrote it."
        )
    for name, parameter in parameters.items():
        parameter.copy_(tensors[name])


def read_last(run: TrainingRun, world: World) -> tuple[Normalization, PolicyShape, TrainerState]:
    """What a run goes on from, read on rank 0 and sent to the others.

    Raises `CheckpointIncomplete` or `CheckpointMismatch`.
    """
    tensors: dict[str, Tensor] = {}

    def read() -> tuple[Normalization, PolicyShape, TrainerState]:
        checkpoint, state = load_policy(run.last), read_trainer(run.last)
        tensors.update(state.tensors)
        # Tensors are not pickled with the rest, but sent one by one.
        return checkpoint.normalization, checkpoint.shape, replace(state, tensors={})

    normalization, shape, state = world.shared(read)
    return normalization, shape, replace(state, tensors=world.tensors(tensors))
