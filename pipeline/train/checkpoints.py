"""What going on with a run takes beyond its policy, as safetensors and JSON, and the way back."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor, nn

from pipeline.base.differences import describe, differences
from pipeline.base.durable import (
    damaged,
    read_document,
    read_tensors,
    write_tensors,
    write_with_digest,
)
from pipeline.base.errors import CheckpointIncomplete, CheckpointMismatch, PipelineError
from pipeline.policy.checkpoint import load_policy
from pipeline.policy.normalization import Normalization
from pipeline.policy.observation import PolicyShape
from pipeline.train.log import Row
from pipeline.train.run import TRAINER_DOCUMENT, TRAINER_WEIGHTS, TrainingRun
from pipeline.train.world import World

_KINDS = ("weights", "average", "optimizer")
_DOCUMENT = ("step", "columns", "best_error", "stalled", "trained_s", "rows")


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
    history: Float64[Tensor, "step column"]
    """A row for every step so far."""
    columns: Sequence[str]
    best_error: float | None
    stalled: int
    """Evaluations since the best one."""
    trained_s: float
    """Seconds of training so far, over all starts."""
    rows: Sequence[Row]


def write_trainer(folder: Path, state: TrainerState) -> None:
    """Write the two files of a trainer's state into an existing folder."""
    tensors = {
        f"{kind}:{name}": value for kind in _KINDS for name, value in getattr(state, kind).items()
    }
    digest = write_tensors(folder / TRAINER_WEIGHTS, tensors | {"history:": state.history})
    document = {name: getattr(state, name) for name in _DOCUMENT} | {"weights_sha256": digest}
    write_with_digest(folder / TRAINER_DOCUMENT, document)


def read_trainer(folder: Path) -> TrainerState:
    """The state at `folder`; `CheckpointIncomplete` where a file is missing or damaged."""
    path = folder / TRAINER_DOCUMENT
    try:
        document = read_document(path)
        tensors: dict[str, dict[str, Tensor]] = {kind: {} for kind in (*_KINDS, "history")}
        stored = read_tensors(folder / TRAINER_WEIGHTS, document["weights_sha256"])
        for key, value in stored.items():
            kind, _, name = key.partition(":")
            tensors[kind][name] = value
        history = tensors.pop("history")[""]
        rest: dict[str, Any] = {name: document[name] for name in _DOCUMENT}
        return TrainerState(history=history, **tensors, **rest)
    except PipelineError:
        raise
    except (KeyError, TypeError, ValueError) as error:
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
    tensors: dict[str, Mapping[str, Tensor]] = {}

    def read() -> tuple[Normalization, PolicyShape, TrainerState]:
        checkpoint, state = load_policy(run.last), read_trainer(run.last)
        tensors.update({kind: getattr(state, kind) for kind in _KINDS})
        # Tensors are not pickled with the rest, but sent one by one.
        rest = replace(state, weights={}, average={}, optimizer={})
        return checkpoint.normalization, checkpoint.shape, rest

    normalization, shape, rest = world.shared(read)
    sent = {kind: world.tensors(tensors.get(kind, {})) for kind in _KINDS}
    return normalization, shape, replace(rest, **sent)
