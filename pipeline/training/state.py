"""What going on with a run takes beyond its policy, as safetensors and JSON."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from pipeline.durable import (
    damaged,
    read_document,
    read_tensors,
    write_document,
    write_tensors,
)
from pipeline.errors import CheckpointIncomplete, PipelineError
from pipeline.training.log import Row
from pipeline.training.run import TRAINER_DOCUMENT, TRAINER_WEIGHTS


@dataclass(frozen=True)
class TrainerState:
    """A run after `step` steps.

    There is no random state and no schedule state in it: both follow from the seed and the step.
    The averaged weights are those of the policy checkpoint beside it.
    """

    step: int
    weights: Mapping[str, Tensor]
    """The policy's own, not averaged."""
    optimizer: Mapping[str, Tensor]
    history: Tensor
    """(step, column) float64, a row for every step so far."""
    columns: tuple[str, ...]
    best_error: float | None
    rows: tuple[Row, ...]


def write_trainer(folder: Path, state: TrainerState) -> None:
    """Write the two files of a trainer's state into an existing folder."""
    tensors = {f"policy:{name}": value for name, value in state.weights.items()}
    tensors |= {f"optimizer:{name}": value for name, value in state.optimizer.items()}
    digest = write_tensors(folder / TRAINER_WEIGHTS, tensors | {"history:": state.history})
    write_document(
        folder / TRAINER_DOCUMENT,
        {
            "step": state.step,
            "columns": list(state.columns),
            "best_error": state.best_error,
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
    kinds: dict[str, dict[str, Tensor]] = {"policy": {}, "optimizer": {}, "history": {}}
    for key, value in tensors.items():
        kind, _, name = key.partition(":")
        kinds[kind][name] = value
    return TrainerState(
        step=document["step"],
        weights=kinds["policy"],
        optimizer=kinds["optimizer"],
        history=kinds["history"][""],
        columns=tuple(document["columns"]),
        best_error=document["best_error"],
        rows=tuple((step, metrics) for step, metrics in document["rows"]),
    )
