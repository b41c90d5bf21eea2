"""What going on with a run takes beyond its policy, as safetensors and JSON."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pipeline.base.durable import (
    damaged,
    read_document,
    read_tensors,
    write_tensors,
    write_with_digest,
)
from pipeline.base.errors import CheckpointIncomplete, CheckpointMismatch, PipelineError
from pipeline.train.log import Row
from pipeline.train.run import TRAINER_DOCUMENT, TRAINER_WEIGHTS

KINDS = ("weights", "average", "optimizer")


@dataclass(frozen=True)
class TrainerState:
    """A run after `step` steps.

    There is no random state and no schedule state in it: both follow from the seed and the step.
    """

    step: int
    weights: Mapping[str, Tensor]
    """What learns, by its name in the trained module."""
    average: Mapping[str, Tensor]
    """The moving average of each of `weights`."""
    optimizer: Mapping[str, Tensor]
    history: Tensor
    """(step, column) float64, a row for every step so far."""
    columns: tuple[str, ...]
    best_error: float | None
    stalled: int
    """Evaluations since the best one."""
    trained_s: float
    """Seconds of training so far, over all starts."""
    rows: tuple[Row, ...]


def write_trainer(folder: Path, state: TrainerState) -> None:
    """Write the two files of a trainer's state into an existing folder."""
    tensors = {
        f"{kind}:{name}": value for kind in KINDS for name, value in getattr(state, kind).items()
    }
    digest = write_tensors(folder / TRAINER_WEIGHTS, tensors | {"history:": state.history})
    write_with_digest(
        folder / TRAINER_DOCUMENT,
        {
            "step": state.step,
            "columns": list(state.columns),
            "best_error": state.best_error,
            "stalled": state.stalled,
            "trained_s": state.trained_s,
            "rows": [[step, dict(metrics)] for step, metrics in state.rows],
            "weights_sha256": digest,
        },
    )


def read_trainer(folder: Path) -> TrainerState:
    """The state at `folder`; `CheckpointIncomplete` where a file is missing or damaged."""
    path = folder / TRAINER_DOCUMENT
    try:
        return _state(folder, read_document(path))
    except PipelineError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        why = f"not what it must hold ({type(error).__name__}: {error})"
        raise CheckpointIncomplete(damaged(path, why)) from None


def _state(folder: Path, document: Mapping[str, Any]) -> TrainerState:
    tensors = read_tensors(folder / TRAINER_WEIGHTS, document["weights_sha256"])
    kinds: dict[str, dict[str, Tensor]] = {kind: {} for kind in (*KINDS, "history")}
    for key, value in tensors.items():
        kind, _, name = key.partition(":")
        kinds[kind][name] = value
    return TrainerState(
        step=document["step"],
        **{kind: kinds[kind] for kind in KINDS},
        history=kinds["history"][""],
        columns=tuple(document["columns"]),
        best_error=document["best_error"],
        stalled=document["stalled"],
        trained_s=document["trained_s"],
        rows=tuple((step, metrics) for step, metrics in document["rows"]),
    )


@torch.no_grad()
def load_weights(
    parameters: Mapping[str, nn.Parameter], tensors: Mapping[str, Tensor], place: Path
) -> None:
    """Lay the tensors into the parameters of the same names.

    Raises `CheckpointMismatch` where names or shapes are others.
    """
    wanted = {name: tuple(value.shape) for name, value in parameters.items()}
    found = {name: tuple(value.shape) for name, value in tensors.items()}
    if wanted != found:
        name = next(n for n in (*wanted, *found) if wanted.get(n) != found.get(n))
        raise CheckpointMismatch(
            f"{place}: expected what learns in this run, {len(wanted)} parameters; at {name} that "
            f"is {wanted.get(name)}, the checkpoint has {found.get(name)}. Remove {place} to begin "
            "anew, or use the version of this code that wrote it."
        )
    for name, parameter in parameters.items():
        parameter.copy_(tensors[name])
