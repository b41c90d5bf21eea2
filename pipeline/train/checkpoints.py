"""The trainer's state beside a policy, as safetensors and JSON: all that resuming a run needs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor, nn

from pipeline.base.border import Document, Text
from pipeline.base.differences import describe, differences
from pipeline.base.errors import CheckpointMismatch
from pipeline.base.files import read_document, read_tensors, write_tensors, write_with_digest
from pipeline.policy.checkpoint import Sha256
from pipeline.train.run import TRAINER_DOCUMENT, TRAINER_WEIGHTS


class TrainerState(Document):
    """A run after `step` steps, as in `trainer.json`.

    It has no random state and no schedule state: both follow from the seed and the step.
    """

    step: Annotated[int, Field(ge=0)]
    columns: tuple[Text, ...]
    """Column names of the history."""
    best_error: float | None
    stalled: Annotated[int, Field(ge=0)]
    """Evaluations since the best one."""
    trained_s: Annotated[float, Field(ge=0)]
    """Seconds of training so far, over all starts."""
    rows: tuple[tuple[int, dict[Text, float]], ...]
    weights_sha256: Sha256


def write_trainer(folder: Path, state: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    """Write the two files of a trainer's state into an existing folder.

    `state` has the fields of `TrainerState` except the digest. `tensors` are the trainable
    parameters (`weights:<name in the trained module>`), their moving averages (`average:`), the
    optimizer's state (`optimizer:`), and a row for every step so far (`history:`).
    """
    digest = write_tensors(folder / TRAINER_WEIGHTS, tensors)
    write_with_digest(folder / TRAINER_DOCUMENT, {**state, "weights_sha256": digest})


def read_trainer(folder: Path) -> tuple[TrainerState, dict[str, Tensor]]:
    """The state at `folder`. Raises `CheckpointIncomplete` where a file is missing or damaged."""
    state, _ = read_document(folder / TRAINER_DOCUMENT, TrainerState)
    return state, read_tensors(folder / TRAINER_WEIGHTS, state.weights_sha256)


def of_kind(tensors: Mapping[str, Tensor], kind: str) -> dict[str, Tensor]:
    """The tensors of one kind, by name."""
    kind += ":"
    return {k.removeprefix(kind): value for k, value in tensors.items() if k.startswith(kind)}


@torch.no_grad()
def load_weights(
    parameters: Mapping[str, nn.Parameter], tensors: Mapping[str, Tensor], place: Path
) -> None:
    """Copy the tensors into the parameters of the same names.

    Raises `CheckpointMismatch` where names or shapes differ.
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
