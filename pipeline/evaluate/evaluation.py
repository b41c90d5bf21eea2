"""A policy evaluated, and on what, so that two evaluations can be told to be of the same things."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from pipeline.base.config import EvaluateParams
from pipeline.evaluate.ablation import AblationStudy, evaluate_ablation
from pipeline.evaluate.curves import TrainingCurves, read_curves
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.policy import Trainable
from pipeline.store import FeatureStore
from pipeline.train.batches import Windows
from pipeline.train.predictions import Predictions
from pipeline.train.scores import Comparison, evaluate_policy
from pipeline.train.split import find_ticks, source_of

JUDGED = "judged.json"
"""Its name in the folder of an evaluation, beside metrics.json."""


@dataclass(frozen=True)
class Evaluation:
    """A policy that was evaluated, and all that is known of it."""

    name: str
    """Of the checkpoint, as the user called it."""
    checkpoint: PolicyCheckpoint
    store: FeatureStore
    comparison: Comparison
    predictions: Predictions
    study: AblationStudy | None
    judged: Mapping[str, Any]
    """`judged_document`."""
    curves: TrainingCurves
    recordings: Path
    """Below which a relative path of the store lies."""


def evaluate_checkpoint(
    folder: Path,
    checkpoint: PolicyCheckpoint,
    store: FeatureStore,
    wanted: EvaluateParams,
    device: torch.device,
    recordings: Path,
    say: Callable[[str], None],
) -> Evaluation:
    """The policy of the checkpoint in `folder`, on its test ticks of a store it fits.

    `say` is told first what is evaluated on what. Raises `CheckpointMismatch` as `find_ticks`
    does, and `NumericsError` as `predict`.
    """
    names = checkpoint.split["test"].keys()
    ticks, checkpoint = find_ticks(store, checkpoint, "test")
    if renamed := names - checkpoint.split["test"].keys():
        say(f"held-out episodes renamed since the training: {len(renamed)}, told by their content")
    policy = checkpoint.policy(device)
    judged = judged_document(checkpoint, policy, store, wanted.samples, wanted.batch_size)
    say(
        f"{folder} (step {checkpoint.step}) on {len(ticks)} held-out ticks of "
        f"{len(checkpoint.split['test'])} episode(s) in {store.path}, device {device}, "
        f"{judged['policy']['samples']} chunk(s) a tick"
    )
    seen = (policy, store, ticks, Windows.of(checkpoint.params), wanted.batch_size)
    comparison, predictions = evaluate_policy(
        *seen, checkpoint.normalization, progress=True, samples=wanted.samples
    )
    study = None
    if wanted.modalities:
        study = evaluate_ablation(
            checkpoint, policy, store, ticks, wanted.batch_size, wanted.samples, progress=True
        )
    curves = read_curves(checkpoint)
    return Evaluation(
        str(folder), checkpoint, store, comparison, predictions, study, judged, curves, recordings
    )


def judged_document(
    checkpoint: PolicyCheckpoint,
    policy: Trainable,
    store: FeatureStore,
    samples: int,
    batch_size: int,
) -> dict[str, Any]:
    """What was evaluated (`policy`), how it was sampled (`drawn`) and on what (`on`), as JSON.

    `on` is equal for all evaluations whose errors may stand in one table, whatever features the
    policies saw: which are better is a question to ask. `drawn` is equal for those
    of stochastic policies: the mean of fewer samples errs more, and a batch shares its noise. It
    is null for policies that do not sample.
    """
    params = checkpoint.params
    source = source_of(store)
    drawn = {"samples": samples, "batch_size": batch_size} if policy.stochastic else None
    return {
        "policy": {
            "model_type": params.model_type,
            "fusion_strategy": params.fusion_strategy,
            "step": checkpoint.step,
            "parameters": sum(count for _, count in policy.parameter_table()),
            "samples": drawn["samples"] if drawn else 1,
            "logs": str(params.logs),
        },
        "drawn": drawn,
        "feature_spec": source["feature_spec"]["digest"],
        "on": {
            "action": source["streams"]["action"],
            "action_hz": source["action_hz"],
            "vlm_reuse_count": source["vlm_reuse_count"],
            "horizon": params.horizon,
            "held_out": {
                name: {"ticks": list(part.ticks), "content": part.content}
                for name, part in checkpoint.split["test"].items()
            },
        },
    }
